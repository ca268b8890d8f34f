"""The newest episode as a video beside its charts: the recorded one, not another."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from codetr_ros.cli import rendering
from codetr_ros.cli.replayed import EpisodeVideos, read, write
from codetr_ros.config import Settings
from codetr_ros.cores import in_process
from codetr_ros.pages.feed import Feed
from codetr_ros.pages.watching import RunSource, serve
from codetr_ros.records import EpisodeResult, Record
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs.newest_episode import NewestEpisode
from codetr_ros.seeding import seed_global
from codetr_ros.simulation import tasks
from codetr_ros.simulation.open_episode import DiffersError
from codetr_ros.simulation.replay import Recorded, replay
from helpers.builders import tiny
from helpers.http import ask

DEADLINE = 120.0  # [s]


@pytest.fixture(scope='module')
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Settings, Recorded, float]:
    """A run's folder and settings, its newest episode, and what that returned."""
    settings = tiny(task='Reacher-v5', steps=400, warmup_steps=200, method='uniform')
    folder = tmp_path_factory.mktemp('run')
    run_folder.write_settings(folder, settings)
    newest = NewestEpisode()
    returns: dict[int, float] = {}

    def observe(record: Record) -> None:
        newest.receive(record)
        if isinstance(record, EpisodeResult) and record.purpose == 'training':
            returns[record.episode] = record.true_return

    in_process.run(settings, 'r', None, observe)
    arrays = newest.arrays()
    assert arrays is not None
    recorded = Recorded(*arrays)
    return folder, settings, recorded, returns[recorded.episode]


def made(settings: Settings) -> tasks.Environment:
    seed_global(settings.seed, 'environment')
    return tasks.make(settings.task)


def test_a_recorded_episode_is_gone_through_again_to_the_bit(done):
    _, settings, recorded, _ = done
    steps = list(replay(made(settings), settings.seed, recorded))
    assert steps == list(range(len(recorded.actions))) == list(range(50))


def test_another_episode_or_another_action_is_noticed(done):
    _, settings, recorded, _ = done
    actions = recorded.actions.copy()
    actions[7] = -actions[7]
    wrong = Recorded(recorded.source, recorded.episode, recorded.observations, actions)
    with pytest.raises(DiffersError, match='observation of step 8 is not'):
        list(replay(made(settings), settings.seed, wrong))
    other = Recorded(recorded.source, recorded.episode + 1, recorded.observations, actions)
    with pytest.raises(DiffersError, match='observation of step 0 is not'):
        list(replay(made(settings), settings.seed, other))


def test_an_episode_on_its_way_to_the_program_that_draws_it_is_unchanged(done, tmp_path: Path):
    recorded = done[2]
    write(recorded, tmp_path / 'episode.npz')
    again = read(tmp_path / 'episode.npz')
    assert (again.source, again.episode) == (recorded.source, recorded.episode)
    np.testing.assert_array_equal(again.observations, recorded.observations)
    np.testing.assert_array_equal(again.actions, recorded.actions)


@pytest.mark.slow
def test_the_charts_follow_the_video_of_the_newest_episode(done, tab: Callable[..., Any]):
    if rendering.find().driver is None:
        pytest.skip('neither EGL nor OSMesa draws on this machine')
    folder, settings, recorded, _ = done
    feed = Feed()
    source = RunSource(folder, settings, feed)
    shown = {
        'inferred': [0.5] * 50, 'true': [None] * 50, 'observations': [[0.0] * 50],
        'actions': [[0.0] * 50], 'source': 'sim', 'episode': recorded.episode, 'phase': 1,
        'steps': 50, 'terminated': False, 'scores': [], 'observation_size': 1, 'action_size': 1,
    }  # fmt: skip
    feed.publish('episode', shown)

    def publish(value: dict[str, Any]) -> None:
        feed.publish('video', value)

    with EpisodeVideos(folder, settings, publish) as videos:
        place = videos.place
        with serve(source, feed, videos=place) as server:
            page = tab(server.url)
            videos.look(None)
            videos.look(recorded)
            videos.look(recorded)  # it is being drawn
            page.wait_for_selector('#video video', timeout=DEADLINE * 1000)
            page.wait_for_selector('#rewards canvas')
            video = page.locator('#video video')
            while video.evaluate('one => one.readyState') < 2:  # the first frame is not there
                page.wait_for_timeout(20)
            assert video.evaluate('one => one.videoWidth') == 640
            assert video.evaluate('one => one.duration') == pytest.approx(1.0, abs=0.03)
            video.evaluate('one => { one.currentTime = 0.5; }')
            page.wait_for_selector('#rewards .u-series:nth-child(1) .u-value:text-is("25")')
            assert ask(server.address.port, '/video/7.mp4').status == 404
            assert ask(server.address.port, '/video/episode.npz').status == 404
    assert not place.exists()


def test_the_page_names_why_an_episode_is_not_drawn(
    done, tab: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(os.environ, 'MUJOCO_GL', 'disable')
    folder, settings, recorded, _ = done
    feed = Feed()
    source = RunSource(folder, settings, feed)
    with (
        EpisodeVideos(folder, settings, lambda value: feed.publish('video', value)) as videos,
        serve(source, feed, videos=videos.place) as server,
    ):
        page = tab(server.url)
        videos.look(recorded)
        page.wait_for_selector('#no-video:has-text("is not drawn: disable: ")', timeout=120_000)
