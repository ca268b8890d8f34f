"""How fast are bags recorded, verified, recovered, read and played, compared with rosbags?

    .venv/bin/python benchmarks/bags.py

Steps have Ant's sizes: 8 actions and 27 observations (Ant-v4) or 105 (Ant-v5). A million of each,
random numbers, in the shape of a run: chunks of 500 steps, a phase and its commit every 1000, an
episode every 1000, a score and a true reward for every 25 steps, labels for each phase. The
messages are encoded before the clock starts. Timed are:

  record            our writer, with an fsync before and after each commit's message (two syncs for
                    each 1000 steps), as in the recorder
  write, rosbags    the same bytes with rosbags' writers, MCAP and SQLite: no sync, no CRC
  read raw          every message as bytes; ours checks every CRC, rosbags writes none
  read decoded      every message decoded; ours into records that own their memory, rosbags' into
                    views on the bytes
  into memory       Transitions and scores into `Trajectories`, ready to be sampled
  verify            everything that `codetr bag verify` compares
  recover           a bag whose index and last bytes are gone to a whole one, verified
  info              the counts of `codetr bag info`
  play              `codetr bag play` to a live reward node, from the first commit played to the
                    last phase handled. Its method is `uniform`, which learns nothing, and it has
                    no folder for checkpoints, each of which waits for the disk: the time is that
                    of reading, publishing, receiving and labelling. Skipped without ROS

MB are those of the messages' bytes. Each is done once, one after the other, in one process, with
the files in the page cache as the writers left them; playing takes two more processes. Rates are
by the clock; `cpu_s` is the CPU time of the process itself (playing: player and reward node),
which other work on the machine changes less.
"""

import argparse
import csv
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter

import bag_playing
import machine
from codetr_ros.bags.definitions import encode, own_types
from codetr_ros.bags.info import survey
from codetr_ros.bags.reader import Bag
from codetr_ros.bags.recover import recover
from codetr_ros.bags.topics import BagTopic
from codetr_ros.bags.verify import verify
from codetr_ros.bags.writer import McapWriter
from codetr_ros.config import Settings, load
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import (
    PROTOCOL_VERSION,
    TOPICS,
    Commit,
    CompositeReward,
    Record,
    StepRewards,
    TaskSpec,
    Transitions,
    TrueRewards,
)
from codetr_ros.records.fields import type_name

PHASE, CHUNK, DELAY, ACTIONS = 1000, 500, 25, 8
RESULTS = Path(__file__).parent / 'results' / 'bags'
COLUMNS = ('what', 'by', 'observations', 'steps', 'seconds', 'cpu_s', 'steps_per_s', 'MB_per_s')


def settings_of(steps: int) -> Settings:
    """The settings of the run, whose reward node learns nothing, so as not to hide playing."""
    about = {'steps': steps, 'delay': DELAY, 'task': 'Ant-v5', 'method': 'uniform'}
    return load('cpu').changed(about)


def a_run(steps: int, observations: int) -> Iterator[list[Record]]:
    """Yield the records up to each commit, one phase after the other."""
    rng = np.random.default_rng(0)
    settings = settings_of(steps)
    task = TaskSpec(
        run_id='run',
        protocol_version=PROTOCOL_VERSION,
        source='sim',
        task='Ant-v5',
        observation_size=observations,
        action_size=ACTIONS,
        horizon=PHASE,
        control_period=0.05,
        r_max=1.0,
    )
    opening: list[Record] = [settings.run_spec('run'), task]
    score = 0
    for phase in range(steps // PHASE):
        records, opening = opening, []
        drawn = rng.normal(size=(PHASE + 1, observations)).astype(np.float32)
        for half in range(PHASE // CHUNK):
            first = half * CHUNK
            last = first + CHUNK == PHASE
            actions = rng.uniform(-1, 1, (CHUNK, ACTIONS)).astype(np.float32)
            seen = drawn[first : first + CHUNK + 1]
            due = PHASE // DELAY * last
            records += [
                Transitions(
                    run_id='run',
                    source='sim',
                    sequence=PHASE // CHUNK * phase + half,
                    phase=phase,
                    episode=phase,
                    first_step=first,
                    steps=CHUNK,
                    observations=seen,
                    actions=actions,
                    terminated=False,
                    truncated=last,
                    phase_end=last,
                    scores_due=due,
                ),
                TrueRewards(
                    run_id='run',
                    source='sim',
                    sequence=PHASE // CHUNK * phase + half,
                    phase=phase,
                    episode=phase,
                    first_step=first,
                    rewards=rng.normal(size=CHUNK).astype(np.float32),
                ),
            ]
            for start in range(first, first + CHUNK, DELAY):
                value = float(rng.normal())
                records.append(
                    CompositeReward(
                        run_id='run',
                        source='sim',
                        scorer='sim',
                        sequence=score,
                        episode=phase,
                        first_step=start,
                        length=DELAY,
                        value=value,
                    )
                )
                score += 1
        ends = np.array([PHASE // CHUNK * (phase + 1) - 1]), np.array([score - 1])
        records.append(
            Commit(
                run_id='run',
                phase=phase,
                sources=('sim',),
                transitions=ends[0],
                scorers=('sim',),
                scores=ends[1],
                dropped=(),
            )
        )
        starts = np.arange(0, PHASE, DELAY, dtype=np.uint32)
        same = np.full(len(starts), phase, np.uint32), np.full(len(starts), DELAY, np.uint32)
        labels = rng.normal(size=PHASE).astype(np.float32)
        opening = [
            StepRewards(
                run_id='run',
                phase=phase,
                version=phase,
                part=0,
                parts=1,
                source='sim',
                episodes=same[0],
                first_steps=starts,
                lengths=same[1],
                labels=labels,
            )
        ]
        yield records
    yield opening


class Stopwatch:
    """Adds up the time within its `with` blocks."""

    def __init__(self) -> None:
        self.seconds = self.cpu = 0.0

    def __enter__(self) -> None:
        self._began = time.perf_counter(), time.process_time()

    def __exit__(self, *about: object) -> None:
        self.seconds += time.perf_counter() - self._began[0]
        self.cpu += time.process_time() - self._began[1]


def record(folder: Path, phases: Iterator[list[Record]]) -> tuple[Stopwatch, int]:
    """The time that our writer takes, and the bytes of all messages."""
    watch, size, now = Stopwatch(), 0, 0
    topics = [BagTopic(f'/run/{t}', type_name(k), 100, False) for k, t in TOPICS.items()]
    writer = McapWriter(folder, topics)
    for records in phases:
        raw = [(f'/run/{TOPICS[type(r)]}', encode(r), isinstance(r, Commit)) for r in records]
        size += sum(len(data) for _, data, _ in raw)
        with watch:
            for topic, data, commits in raw:
                now += 1
                if commits:
                    writer.flush()
                writer.write(topic, data, now)
                if commits:
                    writer.flush()
    with watch:
        writer.close()
    return watch, size


def write_with_rosbags(
    folder: Path, phases: Iterator[list[Record]], plugin: StoragePlugin
) -> Stopwatch:
    """The time that the writer of rosbags takes."""
    watch, now = Stopwatch(), 0
    writer = RosbagsWriter(folder, version=9, storage_plugin=plugin)
    writer.open()
    connections = {
        kind: writer.add_connection(f'/run/{topic}', type_name(kind), typestore=own_types())
        for kind, topic in TOPICS.items()
    }
    for records in phases:
        raw = [(connections[type(r)], encode(r)) for r in records]
        with watch:
            for connection, data in raw:
                now += 1
                writer.write(connection, now, data)
    with watch:
        writer.close()
    return watch


def read_with_rosbags(folder: Path, decoded: bool) -> int:
    """The number of messages that rosbags reads."""
    count = 0
    with AnyReader([folder], default_typestore=own_types()) as reader:
        for connection, _, raw in reader.messages():
            if decoded:
                reader.deserialize(raw, connection.msgtype)
            count += 1
    return count


def into_memory(folder: Path, steps: int, observations: int) -> int:
    """The number of steps that end up in the memory."""
    memory = Trajectories(observations, ACTIONS, DELAY, steps, 2 * PHASE)
    for entry in Bag(folder).entries([Transitions, CompositeReward]):
        if isinstance(entry.record, Transitions):
            memory.append(entry.record)
        elif isinstance(entry.record, CompositeReward):
            memory.score(entry.record)
    return memory.steps


def cut_short(folder: Path, new: Path) -> Path:
    """The bag as a killed recorder would leave it: hard links, the last file without its end."""
    new.mkdir()
    files = sorted(folder.glob('*.mcap'))
    for path in files[:-1]:
        os.link(path, new / path.name)
    shutil.copy(files[-1], new / files[-1].name)
    os.truncate(new / files[-1].name, files[-1].stat().st_size * 99 // 100)
    return new


def measure(steps: int, observations: int, folder: Path) -> Iterator[dict[str, Any]]:
    """Do everything once; yields a row for each measurement."""
    size = 0

    def row(what: str, by: str, watch: Stopwatch) -> dict[str, Any]:
        seconds = watch.seconds
        cells = dict(
            zip(
                COLUMNS,
                (
                    what, by, observations, steps, round(seconds, 3), round(watch.cpu, 3),
                    round(steps / seconds),
                    round(size / seconds / 1e6, 1),
                ),
                strict=True,
            )
        )  # fmt: skip
        print(cells, flush=True)
        return cells

    def timed(what: str, by: str, call: Callable[[], object]) -> dict[str, Any]:
        watch = Stopwatch()
        with watch:
            call()
        return row(what, by, watch)

    ours, mcap, sqlite = (folder / name for name in ('ours', 'rosbags-mcap', 'rosbags-sqlite'))
    watch, size = record(ours, a_run(steps, observations))
    yield row('record', 'ours, with fsync', watch)
    for name, path, plugin in (
        ('rosbags, MCAP', mcap, StoragePlugin.MCAP),
        ('rosbags, SQLite', sqlite, StoragePlugin.SQLITE3),
    ):
        watch = write_with_rosbags(path, a_run(steps, observations), plugin)
        yield row('write', name, watch)
        yield timed('read raw', f'{name}, its own bag', lambda p=path: read_with_rosbags(p, False))
        yield timed(
            'read decoded', f'{name}, its own bag', lambda p=path: read_with_rosbags(p, True)
        )
        yield timed('read decoded', f'ours, the bag of {name}', lambda p=path: consume(p))
        shutil.rmtree(path)
    yield timed('read raw', 'rosbags, our bag', lambda: read_with_rosbags(ours, False))
    yield timed('read decoded', 'rosbags, our bag', lambda: read_with_rosbags(ours, True))
    yield timed('read raw', 'ours', lambda: sum(1 for _ in Bag(ours).raw()))
    yield timed('read decoded', 'ours', lambda: consume(ours))
    yield timed('into memory', 'ours', lambda: check_memory(ours, steps, observations))
    yield timed('info', 'ours', lambda: survey(ours))
    yield timed('verify', 'ours', lambda: check_sound(ours))
    cut = cut_short(ours, folder / 'cut')
    yield timed('recover', 'ours', lambda: recover(cut, folder / 'recovered'))
    if bag_playing.available():
        watch = Stopwatch()
        watch.seconds, watch.cpu = bag_playing.play(ours, settings_of(steps), folder)
        yield row('play', 'ours, to a reward node', watch)
    else:
        print('play: skipped, rclpy cannot be imported')


def consume(folder: Path) -> int:
    return sum(1 for _ in Bag(folder).entries())


def check_memory(folder: Path, steps: int, observations: int) -> None:
    stored = into_memory(folder, steps, observations)
    assert stored == steps, stored


def check_sound(folder: Path) -> None:
    verdict = verify(folder)
    assert verdict.sound, verdict.findings.named[:3]


def circumstances(load_at_start: str) -> str:
    """The program, machine and versions of the measurement."""
    facts = machine.facts(load_at_start, ('rosbags', 'mcap', 'numpy'))
    return f'`benchmarks/bags.py`, each once: {"; ".join(map(" ".join, facts.items()))}.'


def table(rows: list[dict[str, Any]], about: str) -> str:
    lines = [
        '# Bags: how fast',
        '',
        about,
        '',
        '| | by | observations | seconds | CPU seconds | steps/s | MB/s |',
        '|---|---|---:|---:|---:|---:|---:|',
    ]
    lines += [
        f'| {r["what"]} | {r["by"]} | {r["observations"]} | {r["seconds"]:.1f} | '
        f'{r["cpu_s"]:.1f} | {r["steps_per_s"]:,} | {r["MB_per_s"]:.0f} |'
        for r in rows
    ]
    return '\n'.join(lines) + '\n'


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--steps', type=int, default=1_000_000, help='a multiple of 1000')
    parser.add_argument('--observations', type=int, nargs='+', default=[105, 27])
    parser.add_argument(
        '--out', type=Path, default=RESULTS, help='folder for bags.csv and bags.md'
    )
    given = parser.parse_args()
    about = circumstances(machine.load())
    rows: list[dict[str, Any]] = []
    for observations in given.observations:
        with tempfile.TemporaryDirectory(prefix='codetr-bags-') as folder:
            rows += measure(given.steps, observations, Path(folder))
        save(given.out, rows, about)
    print(table(rows, about))


def save(folder: Path, rows: list[dict[str, Any]], about: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / 'bags.md').write_text(table(rows, about))
    with (folder / 'bags.csv').open('w', newline='') as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)


if __name__ == '__main__':
    main()
