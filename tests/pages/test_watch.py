"""The page of a run in a real browser: live, later, narrow, by keys, and from a hostile folder."""

import csv
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from codetr_ros import cli
from codetr_ros.bags.topics import BagTopic
from codetr_ros.bags.writer import McapWriter
from codetr_ros.config import Settings
from codetr_ros.pages.feed import Feed
from codetr_ros.pages.server import Server
from codetr_ros.pages.watching import RunSource, serve
from codetr_ros.records import Commit, EpisodeResult, Metrics, TrueRewards
from codetr_ros.records.fields import type_name
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs.live import Live
from codetr_ros.runs.progress import Progress
from codetr_ros.runs.summary import Summary
from helpers import slow_robots
from helpers.bags import SETTINGS as OF_BAG
from helpers.bags import a_run as bag_records
from helpers.bags import encode, topic_of
from helpers.builders import score, step_rewards, tiny, transitions
from helpers.http import ask
from helpers.runs import write
from helpers.summaries import SETTINGS, Clock
from helpers.summaries import a_run as table_records

NARROW = 400


@dataclass
class Run:
    """A folder like that of a run in process, whose files a test lets grow."""

    folder: Path
    clock: Clock
    summary: Summary
    live: Live

    def take(self, *records: Any) -> None:
        for record in records:
            if isinstance(record, EpisodeResult | Metrics | Commit):
                self.summary.receive(record)
            self.live.receive(record)
        self.clock.now += 2
        self.live.tick()


def begin(folder: Path, settings: Settings = SETTINGS) -> Run:
    folder.mkdir(exist_ok=True)
    run_folder.write_settings(folder, settings)
    clock = Clock()
    summary = Summary(settings, 'r', in_process=True, clock=clock, command='codetr train')
    progress = Progress(settings, io.StringIO(), live=False)
    return Run(folder, clock, summary, Live(folder, summary, progress, clock=clock))


EPISODE = (transitions(truncated=True), score(), step_rewards())


@contextmanager
def served(folder: Path, **more: Any) -> Iterator[tuple[Server, RunSource]]:
    feed = Feed()
    source = RunSource(folder, run_folder.read_settings(folder), feed, **more)
    source.poll()
    with serve(source, feed) as server:
        yield server, source


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return begin(tmp_path / 'run')


def test_the_page_shows_what_comes_while_it_is_looked_at(run: Run, tab: Callable[..., Any]):
    run.take()
    with served(run.folder) as (server, source):
        page = tab(server.url)
        page.wait_for_selector('#nodes p')
        assert page.inner_text('h1') == 'Reacher-v5: sum of 50 steps, method codetr, seed 0'
        assert page.inner_text('#state').lower() == 'running'
        assert page.locator('#returns canvas').count() == 0
        assert page.inner_text('#episode') == 'No episode has ended yet.'

        run.take(*table_records()[:6], *EPISODE)
        source.poll()
        page.wait_for_selector('#facts:has-text("1 of 3")')  # published behind the rest
        page.wait_for_selector('#returns canvas')
        page.wait_for_selector('#rewards canvas')
        label = page.get_attribute('#returns', 'aria-label')
        assert 'evaluation 20, training 50' in label
        assert 'Episode 0 of sim' in page.inner_text('#episode')
        assert page.inner_text('#facts').split('\n')[:4] == [
            'phase',
            '1 of 3',
            'steps',
            '1000 of 2500',
        ]

        run.take(*table_records())
        source.poll()
        page.wait_for_selector('#facts:has-text("3 of 3")')
        assert 'evaluation 225, training 50' in page.get_attribute('#returns', 'aria-label')
        assert 'critic loss 0.3333' in page.get_attribute('#losses .chart', 'aria-label')
        run.live.end('failed', 'the disk is <b>full</b>')
        source.poll()
        page.wait_for_selector('#failure:visible')
        assert page.inner_text('#failure') == 'the disk is <b>full</b>'
        assert page.locator('#failure b').count() == 0


def test_true_rewards_have_an_axis_of_their_own_where_scores_have_a_unit_of_their_own(
    tmp_path: Path, tab: Callable[..., Any]
):
    for name, changes in (('simulator', {}), ('person', {'scorer': 'person'})):
        run = begin(tmp_path / name, SETTINGS.changed({'method': 'evidence', **changes}))
        true = TrueRewards(
            run_id='run', source='sim', sequence=0, phase=0, episode=0, first_step=0,
            rewards=np.linspace(-9, 9, 5, dtype=np.float32),
        )  # fmt: skip
        run.take(transitions(truncated=True), score(), true, step_rewards())
        with served(run.folder) as (server, _):
            page = tab(server.url)
            page.wait_for_selector('#rewards canvas')
            label = page.get_attribute('#rewards', 'aria-label')
            assert ('true (for you alone, right axis) 9' in label) == (name == 'person')
            assert page.locator('#rewards .u-axis').count() == 2 + (name == 'person')


def test_a_finished_run_and_a_copy_of_it_show_the_same(run: Run, tab, tmp_path: Path):
    run.take(*table_records(), *EPISODE)
    run.live.end('finished')
    shutil.copytree(run.folder, tmp_path / 'copy')
    (tmp_path / 'copy' / 'film.png').write_bytes(b'\x89PNG\r\n\x1a\n')
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / 'copy').rglob('*')}
    seen = []
    for folder in (run.folder, tmp_path / 'copy'):
        with served(folder) as (server, _):
            page = tab(server.url)
            page.wait_for_selector('#rewards canvas')
            page.wait_for_selector('#facts:has-text("3 of 3")')
            seen.append([page.inner_text(f'#{name}') for name in ('facts', 'nodes', 'settings')])
            labels = [
                page.get_attribute(f'#{name}', 'aria-label') for name in ('returns', 'rewards')
            ]
            seen[-1] += labels
            if folder != run.folder:
                page.wait_for_selector('#pictures img')
                answer = ask(server.address.port, '/picture/config.yaml')
                assert answer.status == 404
                assert ask(server.address.port, '/picture/..%2Fconfig.yaml').status == 404
    assert seen[0] == seen[1]
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / 'copy').rglob('*')} == before


def test_settings_that_differ_from_the_preset_are_listed(run: Run, tab):
    with served(run.folder) as (server, _):
        page = tab(server.url)
        page.wait_for_selector('#settings td')
        rows = [row.split('\t') for row in page.inner_text('#settings tbody').split('\n')]
    expected = {'steps': ['8000', '2500'], 'evaluate_episodes': ['5', '2']}
    found = {row[0]: row[1:] for row in rows}
    assert found['steps'] == expected['steps']
    assert found['evaluate_episodes'][1] == '2'
    assert set(found) <= {'steps', 'phase_steps', 'evaluate_every', 'evaluate_episodes'}


def test_nothing_of_a_folder_becomes_markup_or_a_script(run: Run, tab):
    evil = '<img src=x onerror="window.hurt=1"><script>window.hurt=1</script>'
    run.take(*table_records(), *EPISODE)
    status = json.loads((run.folder / 'status.json').read_text())
    node = {
        'name': evil,
        'role': evil,
        'doing': evil,
        'finished': False,
        'missed': 0,
        'seen': evil,
    }
    status |= {'state': evil, 'failure': evil, 'namespace': evil, 'nodes': [node]}
    (run.folder / 'status.json').write_text(json.dumps(status))
    episode = json.loads((run.folder / 'newest_episode.json').read_text())
    episode |= {
        'source': evil,
        'scores': [{'first_step': evil, 'length': 1, 'value': 1, 'scorer': evil}],
    }
    (run.folder / 'newest_episode.json').write_text(json.dumps(episode))
    rows = list(csv.reader(io.StringIO((run.folder / 'metrics.csv').read_text())))
    rows[0][2] = evil
    text = io.StringIO()
    csv.writer(text).writerows(rows)
    (run.folder / 'metrics.csv').write_text(text.getvalue())
    (run.folder / '<b>a.mp4').write_bytes(b'')
    with served(run.folder) as (server, _):
        page = tab(server.url)
        page.wait_for_selector('#nodes td')
        page.wait_for_selector('#rewards canvas')
        page.wait_for_selector('#pictures figure')
        assert page.locator('img, script:not([src]), b').count() == 0
        assert page.evaluate('window.hurt') is None
        assert evil in page.inner_text('#nodes')
        page.wait_for_function("document.querySelector('#pictures video').error")
        page.errors.clear()  # the empty video


def test_a_file_that_cannot_be_read_is_named_and_the_rest_is_shown(run: Run, tab):
    run.take(*table_records(), *EPISODE)
    (run.folder / 'newest_episode.json').write_text('{')
    with served(run.folder) as (server, _):
        page = tab(server.url)
        page.wait_for_selector('#returns canvas')
        page.wait_for_selector('#notes li')
        assert 'newest_episode.json' in page.inner_text('#notes')


def test_the_page_fits_400_pixels(run: Run, tab):
    run.take(*table_records(), *EPISODE)
    with served(run.folder) as (server, _):
        page = tab(server.url, width=NARROW)
        page.wait_for_selector('#rewards canvas')
        for scheme in ('light', 'dark'):  # which draws the charts anew
            page.emulate_media(color_scheme=scheme)
            page.wait_for_selector('#rewards canvas')
            assert page.evaluate('document.documentElement.scrollWidth') <= NARROW
            wide = page.evaluate(
                """[...document.querySelectorAll('body *')].filter(one =>
                     !one.closest('.scroll') && one.offsetParent
                     && one.getBoundingClientRect().right > innerWidth + 1).map(one => one.id)"""
            )
            assert wide == []


def test_the_page_is_used_by_keys_alone(run: Run, tab):
    run.take(*table_records(), *EPISODE)
    with served(run.folder) as (server, _):
        page = tab(server.url)
        page.wait_for_selector('#rewards canvas')
        page.wait_for_selector('#facts div')
        page.keyboard.press('Tab')
        assert page.evaluate('document.activeElement.textContent') == 'To the charts'
        reached = []
        for _ in range(14):
            page.keyboard.press('Tab')
            reached.append(page.evaluate('document.activeElement.id'))
        for name in ('returns', 'scores', 'number', 'numbers', 'rewards', 'observations', 'nodes'):
            assert name in reached
        page.focus('#returns')
        outline = page.evaluate(
            "getComputedStyle(document.querySelector('#returns')).outlineStyle"
        )
        assert outline == 'solid'
        page.keyboard.press('Home')
        page.wait_for_selector('#returns .u-series:nth-child(2) .u-value:text-is("20")')
        page.keyboard.press('ArrowRight')
        page.wait_for_selector('#returns .u-series:nth-child(1) .u-value:text-is("1000")')
        page.focus('#number')
        page.keyboard.press('Home')
        for _ in range(page.locator('#number option').count()):  # typing would have to be quick
            if page.input_value('#number') == 'learner.critic_loss':
                break
            page.keyboard.press('ArrowDown')
        page.wait_for_selector('#numbers[aria-label*="critic_loss"]')


def test_a_run_that_is_silent_is_said_to_be(run: Run, tab):
    run.take()
    written = (run.folder / 'status.json').stat().st_mtime
    with served(run.folder, clock=lambda: written + 21) as (server, _):
        page = tab(server.url)
        page.wait_for_selector('#state:has-text("silent for 20 s")')


def test_a_run_over_topics_is_shown_from_its_bag(tmp_path: Path, tab):
    folder = tmp_path / 'run'
    folder.mkdir()
    run_folder.write_settings(folder, OF_BAG)
    records = bag_records(3)
    names = {topic_of(record): type_name(type(record)) for record in records}
    writer = McapWriter(folder / 'bag', [BagTopic(n, t, 10, False) for n, t in names.items()])
    with served(folder) as (server, source):
        page = tab(server.url)
        page.wait_for_selector('#settings td')
        for number, record in enumerate(records):
            writer.write(topic_of(record), encode(record, number), number)
        writer.flush()  # as at a commit: the file is not finished
        source.poll()
        page.wait_for_selector('#rewards canvas')
        page.wait_for_selector('#facts:has-text("3 of 3")')
        assert 'started by hand' in page.inner_text('#state').lower()
        assert 'sim.x' in page.inner_text('#number')
        writer.close()
    assert 'Episode 3 of sim' in page.inner_text('#episode')


def program(*arguments: str, **variables: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, '-m', 'codetr_ros.cli', *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {'COLUMNS': '200'} | variables,
    )


def test_the_command_prints_its_address_and_ends_with_ctrl_c(run: Run, tab):
    run.take(*table_records())
    started = program('watch', str(run.folder))
    watchdog = threading.Timer(250, started.kill)
    watchdog.start()
    try:
        line = started.stdout.readline()
        url = next(word for word in line.split() if word.startswith('http'))
        page = tab(url)
        page.wait_for_selector('#returns canvas')
        started.send_signal(signal.SIGINT)
        assert started.wait(120) == 0
        page.wait_for_selector('#link:has-text("does not answer")')
    finally:
        watchdog.cancel()
        started.kill()
        started.communicate()


def test_a_folder_of_no_run_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert cli.main(['watch', str(tmp_path)]) == cli.USAGE
    assert 'is not the folder of a run' in capsys.readouterr().err


@pytest.mark.slow
def test_a_run_is_watched_while_it_is_trained_until_its_end(tmp_path: Path, tab):
    folder = tmp_path / 'run'
    held = slow_robots.Held(tmp_path, 0.1)
    config = write(tiny(task=slow_robots.POINT), folder)
    flags = ('--in-process', '--watch', '--no-film', '--config', str(config))
    started = program('train', '--out', str(folder), *flags, **held.variables)
    watchdog = threading.Timer(250, started.kill)
    watchdog.start()
    try:
        url = None
        for line in started.stdout:
            if match := re.search(r'http://\S+', line):
                url = match[0]
                break
        page = tab(url)
        page.wait_for_selector('#state:has-text("running")')
        page.wait_for_selector('#nodes:has-text("5 take part")')
        held.let_go()
        page.wait_for_selector('#state:has-text("finished")')
        assert '6 of 6' in page.inner_text('#facts')
        page.wait_for_selector('#rewards canvas')
        said = started.stdout.read()
        assert started.wait(120) == 0, said
        page.wait_for_selector('#link:has-text("codetr watch shows the run again")')
    finally:
        watchdog.cancel()
        started.kill()
        started.communicate()
    assert (folder / 'logs' / 'watch.log').read_text() == ''
