"""What a run leaves in its folder while it lasts: for pages, plots and TensorBoard."""

import csv
import io
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from codetr_ros.cli.audience import Audience
from codetr_ros.cores import in_process
from codetr_ros.records import EpisodeResult, Record, StepRewards
from codetr_ros.runs.live import AT_LEAST, SHARE, Live
from codetr_ros.runs.newest_episode import MOST_CURVES, MOST_HELD, NewestEpisode
from codetr_ros.runs.progress import Progress
from codetr_ros.runs.summary import Summary
from codetr_ros.runs.tensorboard import Events
from helpers.builders import presence, score, step_rewards, tiny, transitions
from helpers.disks import fill, small_disk
from helpers.summaries import SETTINGS, Clock, a_run


def rows(text: str) -> dict[str, dict[str, float]]:
    """The cells of a metrics.csv that are not empty, by phase and column."""
    return {
        row['phase']: {name: float(cell) for name, cell in row.items() if cell and name != 'phase'}
        for row in csv.DictReader(io.StringIO(text))
    }


@dataclass
class Done:
    """A run in process, and what could be seen of it meanwhile."""

    folder: Path
    summary: Summary
    records: list[Record] = field(default_factory=list)
    tables: list[str] = field(default_factory=list)
    statuses: list[dict[str, Any]] = field(default_factory=list)
    episodes: list[dict[str, Any]] = field(default_factory=list)


@pytest.fixture(scope='module')
def done(tmp_path_factory: pytest.TempPathFactory) -> Done:
    folder = tmp_path_factory.mktemp('run')
    settings = tiny()
    summary, clock = Summary(settings, 'r', in_process=True), Clock()
    progress = Progress(settings, io.StringIO(), live=False)
    live = Live(folder, summary, progress, clock=clock)
    events = Events(folder / 'tensorboard', settings, print)
    audience = Audience(summary, progress, live, events)
    seen = Done(folder, summary)

    def observe(record: Record) -> None:
        seen.records.append(record)
        audience.receive(record)

    def tick() -> None:
        clock.now += 0.125
        audience.tick()
        if clock.now % 1:
            return
        for name, kept in (
            ('metrics.csv', seen.tables),
            ('status.json', seen.statuses),
            ('newest_episode.json', seen.episodes),
        ):
            if (folder / name).is_file():
                text = (folder / name).read_text()
                kept.append(text if name.endswith('csv') else json.loads(text))

    in_process.run(settings, 'r', None, observe, tick, live.attend)
    audience.end()
    live.end('finished')
    return seen


def test_the_table_of_a_run_grows_while_it_lasts_and_only_gains(done: Done):
    final = rows(done.summary.metrics_csv())
    tables = [rows(text) for text in done.tables]
    assert len({len(table) for table in tables}) >= 5, 'it was seen at several lengths'
    for table in tables:
        for phase, cells in table.items():
            for name, cell in cells.items():
                if not name.startswith(('evaluation.', 'training.')):  # means grow with episodes
                    assert final[phase][name] == cell


def test_the_status_names_the_phase_and_what_each_part_waits_for(done: Done):
    phases = [status['phase'] for status in done.statuses]
    assert phases == sorted(phases)
    assert {0, 5} <= set(phases)
    doing = {node['doing'] for status in done.statuses for node in status['nodes']}
    assert any('waits for permission for phase' in text for text in doing)
    last = json.loads((done.folder / 'status.json').read_text())
    assert (last['state'], last['phase'], last['lost']) == ('finished', 6, 0)
    assert {node['name'] for node in last['nodes']} == {
        *('sim', 'record', 'reward', 'learner', 'evaluate')
    }
    assert all(node['finished'] for node in last['nodes'])


def test_the_newest_episode_has_the_labels_and_true_rewards_of_its_steps(done: Done):
    assert len({episode['episode'] for episode in done.episodes}) > 5, 'it was seen to change'
    results = {
        result.episode: result
        for result in done.records
        if isinstance(result, EpisodeResult) and result.purpose == 'training'
    }
    labels: dict[tuple[int, int], np.ndarray] = {}
    for record in done.records:
        if isinstance(record, StepRewards):
            at = 0
            for episode, first, length in zip(
                record.episodes, record.first_steps, record.lengths, strict=True
            ):
                labels[int(episode), int(first)] = record.labels[at : at + int(length)]
                at += int(length)
    shown = json.loads((done.folder / 'newest_episode.json').read_text())
    result = results[shown['episode']]
    assert shown['steps'] == result.length
    assert sum(shown['true']) == pytest.approx(result.true_return, rel=1e-3)
    assert sum(s['value'] for s in shown['scores']) == pytest.approx(
        result.composite_return, rel=1e-3
    )
    inferred = [label for label in shown['inferred'] if label is not None]
    expected = [
        label
        for (episode, _), part in sorted(labels.items())
        if episode == shown['episode']
        for label in part
    ]
    assert inferred == pytest.approx(expected, rel=1e-4)
    assert len(shown['observations']) == min(shown['observation_size'], MOST_CURVES)
    assert {len(curve) for curve in shown['observations'] + shown['actions']} == {shown['steps']}


def test_tensorboards_own_reader_finds_the_numbers_of_the_table(done: Done):
    reader = pytest.importorskip('tensorboard.backend.event_processing.event_accumulator')
    events = reader.EventAccumulator(str(done.folder / 'tensorboard'))
    events.Reload()
    tags = events.Tags()['scalars']
    found = {(tag, event.step): event.value for tag in tags for event in events.Scalars(tag)}
    compared = 0
    for cells in rows(done.summary.metrics_csv()).values():
        for name, cell in cells.items():
            node, _, metric = name.partition('.')
            if node == 'evaluation':
                metric, _, kind = metric.rpartition('_')
                if kind != 'mean':
                    continue
            if node not in ('training', 'step'):
                there = found[f'{node}/{metric}', int(cells['step'])]
                assert there == pytest.approx(np.float32(cell), rel=1e-6, nan_ok=True), name
                compared += 1
    assert compared > 50
    returns = [e.true_return for e in done.records if getattr(e, 'purpose', '') == 'training']
    there = [event.value for event in events.Scalars('training/true_return')]
    assert there == pytest.approx(returns, rel=1e-6)


def test_files_are_written_at_most_once_a_second_and_take_a_share_of_the_time(tmp_path: Path):
    written = []

    class Slow(Clock):
        spends = 0.0

        def __call__(self) -> float:
            self.now += self.spends
            return self.now

    clock = Slow()
    summary = Summary(SETTINGS, 'r', in_process=False, clock=clock)
    live = Live(tmp_path, summary, Progress(SETTINGS, io.StringIO(), live=False), clock=clock)

    def ticks(seconds: float) -> int:
        """Writings within a time."""
        written.clear()
        end = clock.now + seconds
        while clock.now < end:
            (tmp_path / 'status.json').unlink(missing_ok=True)
            live.tick()
            written.extend(tmp_path.glob('status.json'))
            clock.now += 0.05
        return len(written)

    assert ticks(10 * AT_LEAST) in (10, 11)
    clock.spends = 0.25  # each look at the clock; a writing takes one
    assert ticks(0.5 / SHARE) <= 3


def test_the_nodes_of_a_run_over_topics_are_those_that_are_present(tmp_path: Path):
    clock = Clock()
    summary = Summary(SETTINGS, 'r', in_process=False, clock=clock)
    progress = Progress(SETTINGS, io.StringIO(), live=False)
    audience = Audience(summary, progress, Live(tmp_path, summary, progress, '/run_r', clock))
    for record in a_run():
        audience.receive(record)
    audience.receive(
        presence(
            'reward',
            run_id='r',
            node='/run_r/reward',
            missed=2,
            doing='waits for the commit of phase 3',
            waiting=4.25,
        )
    )
    audience.tick()
    status = json.loads((tmp_path / 'status.json').read_text())
    assert (status['namespace'], status['lost'], status['state']) == ('/run_r', 2, 'running')
    (node,) = status['nodes']
    assert (node['role'], node['name'], node['missed']) == ('reward', 'reward', 2)
    assert (node['doing'], node['waiting']) == ('waits for the commit of phase 3', 4.2)
    assert not (tmp_path / 'newest_episode.json').exists(), 'the bag has it'


def test_a_full_disk_ends_the_writing_and_not_the_run(tmp_path: Path):
    with small_disk(tmp_path / 'disk', 1) as disk:
        said = io.StringIO()
        clock = Clock()
        progress = Progress(SETTINGS, said, live=False)
        summary = Summary(SETTINGS, 'r', in_process=True, clock=clock)
        events = Events(disk / 'tensorboard', SETTINGS, progress.log)
        audience = Audience(summary, progress, Live(disk, summary, progress, clock=clock), events)
        fill(disk)
        for record in a_run() * 20:
            clock.now += 1
            audience.receive(record)
            audience.tick()
        audience.end()
        audience.live.end('finished')
    lines = [line for line in said.getvalue().splitlines() if 'No space left' in line]
    assert len([line for line in lines if 'no longer shown in its folder' in line]) == 1
    assert len([line for line in lines if 'no more events for TensorBoard' in line]) == 1


def whole(episode: int) -> list[Record]:
    return [
        transitions(episode=episode, sequence=episode, truncated=True),
        score(episode=episode, sequence=episode),
    ]


def test_without_labels_the_newest_episode_is_the_last_that_has_ended():
    newest = NewestEpisode()
    assert newest.document() is None
    for record in [*whole(0), *whole(1), transitions(episode=2)]:
        newest.receive(record)
    shown = newest.document()
    assert shown is not None
    assert (shown['episode'], shown['inferred']) == (1, [None] * 5)
    assert shown['true'] == [None] * 5


def test_an_episode_with_labels_is_preferred_until_a_newer_one_has_some():
    newest = NewestEpisode()
    for record in [*whole(0), *whole(1), *whole(2)]:
        newest.receive(record)
    newest.receive(step_rewards(episodes=np.array([1], np.uint32)))
    assert newest.document()['episode'] == 1
    newest.receive(step_rewards(episodes=np.array([0], np.uint32)))
    assert newest.document()['episode'] == 1
    newest.receive(step_rewards(episodes=np.array([2], np.uint32)))
    assert newest.document()['episode'] == 2


def test_what_waits_for_labels_has_a_bound():
    newest = NewestEpisode()
    for episode in range(2 * MOST_HELD):
        for record in whole(episode):
            newest.receive(record)
    assert len(newest._held) == MOST_HELD
    assert newest.document()['episode'] == 2 * MOST_HELD - 1


def test_the_table_of_a_run_that_goes_on_keeps_what_it_had(tmp_path: Path):
    records = a_run()
    whole = Summary(SETTINGS, 'r', in_process=True)
    for record in records:
        whole.receive(record)
    for part in (records[:5], records[5:]):
        clock = Clock()
        summary = Summary(SETTINGS, 'r', in_process=True, clock=clock)
        progress = Progress(SETTINGS, io.StringIO(), live=False)
        live = Live(tmp_path, summary, progress, clock=clock)
        for record in part:
            summary.receive(record)
            live.receive(record)
        clock.now += 2
        live.tick()
    assert (tmp_path / 'metrics.csv').read_text() == whole.metrics_csv()
