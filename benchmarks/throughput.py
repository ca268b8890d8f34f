"""How fast is each part alone, and the whole, with and without topics? One table, made in one go.

    .venv/bin/python benchmarks/throughput.py

Machines differ, and a shared one differs from minute to minute, so only ratios of numbers from the
same call count. Each round measures every part for some seconds, then makes one whole run in
process (A) and the same run over topics (B): A B A B A B for three rounds. The table gives the
lowest, median and highest round.

Parts, each on one thread (`threads` of the settings) and alone on the machine:
  - the environment under random actions, resets included, and its `step` alone
  - SAC updates, batches sampled from the memory, with the preset's networks and with 256x256 and
    batch 256
  - gradient steps of the reward model, batches sampled from the memory
  - labels: step rewards for whole segments, each taken from the memory
The memory of the last three holds random numbers of the task's sizes, episodes of full length and
so whole segments: short episodes, as at the start of a run, cost the reward model less.

`part of the run` is the time that a part takes for a run's work, divided by the median whole run
in process. That work is the steps, updates and gradient steps of the settings, with all of the
memory labelled in every phase.

Whole runs are the users' own command, `codetr train`. Both evaluate (as often as the table
states), record as always (over topics a bag with an fsync for each phase, in process none) and
save checkpoints. Four times are given:
  - whole run: `wall_s` of `summary.json`, from settings to summary: includes importing torch, and
    over topics the start of all processes, their discovery and their end
  - start: until the first permission to simulate
  - work: from the first permission to the summary, the whole run without its start
  - loop: from the first permission to the last commit; leaves out the last phase's learning and
    evaluation as well as the end of the processes
Over topics the evaluator works beside the loop if there is a free core; in process everything
takes turns.

    .venv/bin/python benchmarks/throughput.py --no-runs

measures the parts only, and writes nothing.
"""

import argparse
import csv
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

import machine
from codetr_ros.config import Settings, load
from codetr_ros.learners.flat_sac import FlatSAC
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import CompositeReward, StepRewards, Transitions
from codetr_ros.rewards import registry
from codetr_ros.rewards.base import segment_steps
from codetr_ros.seeding import generator, seed_torch
from codetr_ros.simulation import tasks

RESULTS = Path(__file__).parent / 'results'
PACKAGES = ('torch', 'numpy', 'mujoco', 'gymnasium')
MARKED = Path(__file__).with_name('marked_train.py')
WORK = ('simulate_seconds', 'fit_seconds', 'label_seconds', 'update_seconds')
"""The nodes' reports of their work: columns of `metrics.csv`, after the node's name."""
Rates = dict[str, float]
COLUMNS = ('what', 'unit', 'rounds', 'min', 'median', 'max', 'part_of_the_run', 'note')


# ----------------------------------------------------------------------------------------------
# parts


def rate(work: Callable[[], int], seconds: float) -> float:
    """The amount of work that a function does in a second, after one call that is not counted."""
    work()
    done, began = 0, time.perf_counter()
    while (spent := time.perf_counter() - began) < seconds:
        done += work()
    return done / spent


class Parts:
    """The parts that are measured alone.

    Args:
        settings: the settings of the run whose parts these are.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.environment = tasks.make(settings.task)
        self.memory = filled_memory(settings, self.environment)
        sizes = self.environment.observation_size, self.environment.action_size
        self.sac = FlatSAC(*sizes, settings.sac, settings.seed)
        self.large = settings.changed({'sac.hidden': (256, 256), 'sac.batch': 256})
        self.large_sac = FlatSAC(*sizes, self.large.sac, settings.seed)
        self.method = registry.make(settings, *sizes)
        self.method.prepare(self.memory)
        self.rng = generator(settings.seed, 'throughput')
        self.episode = 0

    def measure(self, seconds: float) -> Rates:
        """Work per second of each part."""
        seed_torch(self.settings.seed, 'throughput')
        environment = self.environment_rates(seconds)
        return {
            **environment,
            'updates': rate(lambda: self.update(self.sac, self.settings), seconds),
            'large updates': rate(lambda: self.update(self.large_sac, self.large), seconds),
            'gradient steps': rate(self.gradient_step, seconds),
            'labels': rate(self.label, seconds),
        }

    def environment_rates(self, seconds: float) -> Rates:
        """Steps per second with and without the time of resets."""
        size, horizon = self.environment.action_size, self.environment.horizon
        actions = self.rng.random((256, size), dtype=np.float32) * 2 - 1
        steps, resetting, length = 0, 0.0, horizon  # an episode is due
        began = time.perf_counter()
        while (spent := time.perf_counter() - began) < seconds:
            for action in actions:
                if length == horizon:
                    then = time.perf_counter()
                    self.environment.reset(self.episode)
                    resetting += time.perf_counter() - then
                    self.episode += 1
                    length = 0
                terminated = self.environment.step(action)[2]
                length = horizon if terminated else length + 1
                steps += 1
        return {'environment': steps / spent, 'step alone': steps / (spent - resetting)}

    def update(self, sac: FlatSAC, settings: Settings) -> int:
        """Take some SAC updates; returns how many."""
        sac.burst(settings.sac.burst, lambda rows: self.memory.labelled.sample(self.rng, rows))
        return settings.sac.burst

    def gradient_step(self) -> int:
        """Take a gradient step of the reward model; returns 1."""
        self.method.gradient_step(self.memory, self.rng)
        return 1

    def label(self) -> int:
        """Label some segments; returns how many steps they have."""
        ids = self.memory.segments.ids()[: self.settings.codetr.label_batch]
        batch = self.memory.segments.batch(ids, self.method.context)
        return len(self.method.label(batch)[segment_steps(batch)])


def filled_memory(settings: Settings, environment: tasks.Environment) -> Trajectories:
    """A memory D of `settings.steps` labelled steps: random numbers, whole segments."""
    sizes = environment.observation_size, environment.action_size
    horizon, delay = environment.horizon, settings.delay
    memory = Trajectories(*sizes, delay, settings.steps + horizon, horizon)
    rng = generator(settings.seed, 'throughput', 'memory')
    for i in range(-(-settings.steps // horizon)):
        observations = rng.standard_normal((horizon + 1, sizes[0]), dtype=np.float32)
        actions = rng.random((horizon, sizes[1]), dtype=np.float32) * 2 - 1
        memory.append(
            Transitions(
                run_id='',
                source='s',
                sequence=i,
                phase=i,
                episode=i,
                first_step=0,
                steps=horizon,
                observations=observations,
                actions=actions,
                terminated=False,
                truncated=True,
                phase_end=True,
                scores_due=0,
            )
        )
        starts = np.arange(0, horizon, delay, dtype=np.uint32)
        lengths = np.minimum(delay, horizon - starts).astype(np.uint32)
        for first, length in zip(starts.tolist(), lengths.tolist(), strict=True):
            value = float(rng.standard_normal() * length)
            memory.score(
                CompositeReward(
                    run_id='',
                    source='s',
                    scorer='s',
                    sequence=0,
                    episode=i,
                    first_step=first,
                    length=length,
                    value=value,
                )
            )
        labels = rng.standard_normal(horizon, dtype=np.float32)
        episodes = np.full(len(starts), i, np.uint32)
        memory.apply(
            StepRewards(
                run_id='',
                phase=i,
                version=0,
                part=0,
                parts=1,
                source='s',
                episodes=episodes,
                first_steps=starts,
                lengths=lengths,
                labels=labels,
            )
        )
    return memory


def per_run(settings: Settings) -> dict[str, float]:
    """The amount of each part's work in a whole run."""
    fits = settings.phases - settings.warmup_phases
    gradient_steps = settings.codetr.first_gradient_steps + fits * settings.codetr.gradient_steps
    learnt = range(settings.warmup_phases - 1, settings.phases)  # phases with updates and labels
    return {
        'environment': settings.steps,
        'updates': sum(map(settings.steps_of, learnt)) * settings.sac.updates_per_step,
        'gradient steps': gradient_steps,
        'labels': sum(min(settings.memory_steps, settings.steps_after(p)) for p in learnt),
    }


# ----------------------------------------------------------------------------------------------
# whole runs


def whole_run(
    flags: list[str], in_process: bool, environment: Mapping[str, str] | None = None
) -> dict[str, float]:
    """Do one run by the users' own command, in an environment; returns its times [s]."""
    with tempfile.TemporaryDirectory() as folder:
        out, marks = Path(folder, 'run'), Path(folder, 'marks.json')
        command = ['train', '--no-film', *flags, '--out', str(out)]
        if in_process:
            command = [str(MARKED), str(marks), *command]
        else:
            command = ['-m', 'codetr_ros.cli', *command]
        began = time.monotonic()
        done = subprocess.run(
            [sys.executable, *command],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
            env=environment,
        )
        spent = time.monotonic() - began
        if done.returncode:
            raise SystemExit(f'{" ".join(command)} failed:\n{done.stdout[-4000:]}')
        summary = json.loads((out / 'summary.json').read_text())
        if summary['lost'] or summary['refused']:
            print(f'lost {summary["lost"]}, refused {summary["refused"]}', file=sys.stderr)
        # written right before the clock of `wall_s` starts
        start = (out / 'config.yaml').stat().st_mtime_ns
        if in_process:
            permission, commit = json.loads(marks.read_text())
        else:
            permission, commits = marks_of_bag(out / 'bag')
            commit = commits[-1]
        with (out / 'metrics.csv').open() as file:
            rows = list(csv.DictReader(file))
    work = dict.fromkeys(WORK, 0.0)
    for row in rows:
        for column, cell in row.items():
            name = column.rsplit('.', 1)[-1]
            if name in work and cell:
                work[name] += float(cell)
    return {
        'wall': summary['wall_s'],
        'start': (permission - start) / 1e9,
        'rest': summary['wall_s'] - (permission - start) / 1e9,
        'loop': (commit - permission) / 1e9,
        'command': spent,
        **work,
    }


def marks_of_bag(bag: Path) -> tuple[int, list[int]]:
    """The publish time of a bag's first permission, and the log times of its commits [ns]."""
    from mcap.reader import make_reader

    permissions, commits = [], []
    for path in sorted(bag.glob('*.mcap')):
        with path.open('rb') as file:
            for _, channel, message in make_reader(file).iter_messages():
                if channel.topic.endswith('/policy'):
                    permissions.append(message.publish_time)
                elif channel.topic.endswith('/commits'):
                    commits.append(message.log_time)
    return min(permissions), sorted(commits)


# ----------------------------------------------------------------------------------------------
# the table


def table(
    settings: Settings, parts: list[Rates], a: list[dict[str, float]], b: list[dict[str, float]]
) -> list[dict[str, Any]]:
    """All rows, from the rounds' parts, runs in process (a) and runs over topics (b)."""
    rows: list[dict[str, Any]] = []

    def add(
        what: str, unit: str, values: list[float], note: str = '', share: float | None = None
    ) -> None:
        low, middle, high = min(values), statistics.median(values), max(values)
        cells = {'what': what, 'unit': unit, 'rounds': len(values), 'min': low, 'median': middle}
        text = '' if share is None else f'{share:.3f}'
        rows.append({**cells, 'max': high, 'part_of_the_run': text, 'note': note})

    due, wall = per_run(settings), statistics.median(x['wall'] for x in a) if a else None

    def alone(key: str, what: str, unit: str, note: str = '') -> None:
        values = [rates[key] for rates in parts]
        count = due.get(key)
        share = None if wall is None or count is None else count / statistics.median(values) / wall
        add(what, unit, values, note, share)

    sac = settings.sac
    hidden = 'x'.join(map(str, sac.hidden))
    alone('environment', 'environment alone', 'steps/s', 'random actions, resets included')
    alone('step alone', 'environment alone', 'steps/s', 'random actions, without resets')
    note = f'{hidden}, batch {sac.batch}, with sampling'
    alone('updates', 'SAC updates alone', 'updates/s', note)
    alone('large updates', 'SAC updates alone', 'updates/s', '256x256, batch 256, with sampling')
    model = f'layers {settings.codetr.layers}, d {settings.codetr.embedding}'
    batch = f'{model}, {settings.codetr.batch} segments of {settings.delay} steps'
    alone('gradient steps', 'reward model alone', 'gradient steps/s', batch)
    alone('labels', 'reward model alone', 'labelled steps/s', model)
    if not a:
        return rows
    ways = {'in process': a, 'over topics': b}
    for way, runs in ways.items():
        add(f'whole run, {way}', 'steps/s', [settings.steps / x['wall'] for x in runs])
    for way, runs in ways.items():
        add(f'whole run, {way}', 's', [x['wall'] for x in runs], '`wall_s` of the summary')
        add(f'- start, {way}', 's', [x['start'] for x in runs], 'until the first permission')
        note = 'from the first permission to the summary'
        add(f'- work, {way}', 's', [x['rest'] for x in runs], note)
        note = 'from the first permission to the last commit'
        add(f'- loop, {way}', 's', [x['loop'] for x in runs], note)
        note = 'with the interpreter, the report and the picture'
        add(f'command, {way}', 's', [x['command'] for x in runs], note)
        for name in WORK:
            values = [x[name] for x in runs]
            add(f'- {name}, {way}', 's', values, 'sum over the run, as reported by its nodes')
    compared = {'wall': 'whole run', 'rest': 'work', 'loop': 'loop', 'command': 'command'}
    for key, what in compared.items():
        ratios = [y[key] / x[key] for x, y in zip(a, b, strict=True)]
        add(f'{what}: over topics / in process', 'ratio', ratios, 'time, pair by pair')
    return rows


def circumstances(settings: Settings, flags: list[str], load_at_start: str) -> dict[str, str]:
    """The facts on which the numbers depend."""
    evaluations = sum(map(settings.evaluated, range(settings.phases))) + 1
    return {
        **machine.facts(load_at_start, PACKAGES),
        'run': f'codetr train {" ".join(flags)}',
        'evaluations in both whole runs': f'{evaluations}, that of the random policy included; '
        f'episodes in each: {settings.evaluate_episodes}',
    }


def number(value: Any) -> str:
    """A number for tables: four figures, but all digits of a whole number."""
    if not isinstance(value, float):
        return str(value)
    return f'{value:.0f}' if abs(value) >= 1000 else f'{value:.4g}'


def write(out: Path, rows: list[dict[str, Any]], facts: dict[str, str]) -> None:
    """Write `throughput.csv` and `throughput.md`; the facts are rows whose value is the note."""
    out.mkdir(parents=True, exist_ok=True)
    with (out / 'throughput.csv').open('w', newline='') as file:
        writer = csv.DictWriter(file, COLUMNS, restval='', lineterminator='\n')
        writer.writeheader()
        writer.writerows({key: number(value) for key, value in row.items()} for row in rows)
        writer.writerows(
            {'what': key, 'unit': 'fact', 'note': fact} for key, fact in facts.items()
        )
    (out / 'throughput.md').write_text(markdown(rows, facts))


def markdown(rows: list[dict[str, Any]], facts: dict[str, str]) -> str:
    """Table and facts for people."""
    head = [column.replace('_', ' ') for column in COLUMNS]
    lines = ['# Throughput', '', f'| {" | ".join(head)} |', '|---|---|' + '---:|' * 5 + '---|']
    lines += [f'| {" | ".join(number(row[column]) for column in COLUMNS)} |' for row in rows]
    lines += ['', *(f'- {name}: {fact}' for name, fact in facts.items())]
    return '\n'.join(lines) + '\n'


def main() -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--config', default='quick', help='preset or YAML file')
    parser.add_argument('--steps', type=int, default=6000, help='of a whole run')
    parser.add_argument('--repetitions', type=int, default=3, help='rounds')
    parser.add_argument('--seconds', type=float, default=3.0, help='for each part and round')
    parser.add_argument('--no-runs', action='store_true', help='the parts only, write nothing')
    parser.add_argument('--out', type=Path, default=RESULTS)
    arguments = parser.parse_args()
    load_at_start = machine.load()
    print(f'load average at the start: {load_at_start}', file=sys.stderr, flush=True)
    settings = load(arguments.config).changed({'steps': arguments.steps}, 'command line')
    torch.set_num_threads(settings.thread_count)
    flags = ['--config', arguments.config, '--steps', str(arguments.steps)]
    facts = circumstances(settings, flags, load_at_start)
    measured = Parts(settings)
    parts: list[Rates] = []
    runs: dict[bool, list[dict[str, float]]] = {True: [], False: []}
    for i in range(arguments.repetitions):
        parts.append(measured.measure(arguments.seconds))
        for in_process in () if arguments.no_runs else (True, False):
            runs[in_process].append(whole_run(flags, in_process))
            way = 'in process' if in_process else 'over topics'
            wall = runs[in_process][-1]['wall']
            print(f'round {i + 1} of {arguments.repetitions}: {wall:.1f} s {way}', flush=True)
    rows = table(settings, parts, runs[True], runs[False])
    print(markdown(rows, facts), end='')
    if not arguments.no_runs:
        write(arguments.out, rows, facts)
    return 0


if __name__ == '__main__':
    sys.exit(main())
