"""How fast does SAC learn on a GPU, and which kernels does an update take there?

    .venv/bin/python benchmarks/sac_gpu.py

Networks have 256x256 units; batches of 256 come from a memory of a million labelled steps of the
sizes of Ant (27 or 105 observations, 8 actions) and HalfCheetah (17, 6). Compared are:
  - eager: the host launches every operation of an update
  - graph: the operations are recorded once and replayed (`device=cuda`, `sac.compile=false`)
  - compiled graph: they are compiled first (`device=cuda`, `sac.compile=true`)

A round goes through all of them in turn, with `--updates` updates each, timed from the first call
until the GPU has done the last of them. The table gives the median round, and the lowest and
highest in brackets. `phase` is the host's work between two phases of 1000 steps: it copies the new
steps and all labels, and finds out which steps are labelled. `first` is the first such time, with
all of the memory and the recording; `made` is the making of a learner, including compiling.

A profile of some updates follows, by the time of kernels on the GPU: the number of kernels of an
update, and those that take longest. Profilers have been seen to miss or misplace kernels of
replayed graphs: where the profile and the rate disagree, the rate is right.

Without a GPU `--device cpu --steps 3000 --updates 3` shows that the script works, with the eager
form only, and nothing about a GPU.
"""

import argparse
import csv
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.autograd import DeviceType
from torch.profiler import ProfilerActivity, profile

import machine
from codetr_ros.config import SacSettings
from codetr_ros.learners.device_sac import DeviceSAC
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import StepRewards, Transitions

RESULTS = Path(__file__).parent / 'results' / 'sac_gpu'
SIZES = {'Ant 27': (27, 8), 'Ant 105': (105, 8), 'HalfCheetah': (17, 6)}
EPISODE, PHASE = 1000, 1000
PROFILED = 50
TOP = 15


class Run:
    """A memory of random steps to which phases are added."""

    def __init__(self, sizes: tuple[int, int], steps: int) -> None:
        self.memory = Trajectories(*sizes, EPISODE, steps, 2 * EPISODE)
        self._sizes, self._rng, self._episode = sizes, np.random.default_rng(0), 0
        while self.memory.steps < steps:
            self.phase()
        self.label()

    def phase(self) -> None:
        """Add an episode; the oldest goes if the memory is full."""
        O, A = self._sizes  # noqa: E741, N806
        observations = self._rng.standard_normal((EPISODE + 1, O), np.float32)
        actions = self._rng.uniform(-1, 1, (EPISODE, A)).astype(np.float32)
        self.memory.append(
            Transitions(
                run_id='run',
                source='sim',
                sequence=self._episode,
                phase=0,
                episode=self._episode,
                first_step=0,
                steps=EPISODE,
                observations=observations,
                actions=actions,
                terminated=False,
                truncated=True,
                phase_end=True,
                scores_due=0,
            )
        )
        self.memory.evict()
        self._episode += 1

    def label(self) -> None:
        """Apply new labels to every step."""
        first = self._episode - self.memory.steps // EPISODE
        numbers = np.arange(first, self._episode, dtype=np.uint32)
        lengths = np.full(len(numbers), EPISODE, np.uint32)
        labels = self._rng.standard_normal(self.memory.steps, np.float32)
        self.memory.apply(
            StepRewards(
                run_id='run',
                phase=0,
                version=0,
                part=0,
                parts=1,
                source='sim',
                episodes=numbers,
                first_steps=np.zeros_like(numbers),
                lengths=lengths,
                labels=labels,
            )
        )


def forms(
    sizes: tuple[int, int], device: str, batch: int, width: int
) -> dict[str, tuple[DeviceSAC, float]]:
    """The learners to compare, and the seconds that it took to make each."""

    def make(compiling: bool, **options: Any) -> tuple[DeviceSAC, float]:
        settings = SacSettings(hidden=(width, width), batch=batch, compile=compiling)
        began = time.perf_counter()
        return DeviceSAC(*sizes, settings, 0, device, **options), time.perf_counter() - began

    made = {'eager': make(False, record=lambda call: call)}
    if device != 'cpu':
        made |= {'graph': make(False), 'compiled graph': make(True)}
    return made


def seconds(call: Callable[[], object], device: str) -> float:
    """Seconds until the device has done the work of a call."""

    def wait() -> None:
        if device != 'cpu':
            torch.cuda.synchronize(device)

    wait()
    began = time.perf_counter()
    call()
    wait()
    return time.perf_counter() - began


def measure(task: str, arguments: argparse.Namespace) -> tuple[list[dict[str, Any]], str]:
    """All rounds of one size, and the profiles."""
    device, updates = arguments.device, arguments.updates
    run = Run(SIZES[task], arguments.steps)
    rows, profiles = [], []
    timed = forms(SIZES[task], device, arguments.batch, arguments.width)
    made = {name: sac for name, (sac, _) in timed.items()}
    first = {
        name: seconds(lambda sac=sac: sac.take(run.memory), device) for name, sac in made.items()
    }
    for sac in made.values():
        sac.replay(max(1, updates // 10))  # not counted
    for n in range(arguments.rounds):
        run.phase()
        for name, sac in made.items():
            run.label()  # the memory finds out only once which steps are labelled
            phase = seconds(lambda sac=sac: sac.take(run.memory), device)
            took = seconds(lambda sac=sac: sac.replay(updates), device)
            rows.append(
                {'task': task, 'form': name, 'round': n, 'updates': updates}
                | {'seconds': round(took, 5), 'phase_s': round(phase, 5)}
                | {'first_s': round(first[name], 2), 'made_s': round(timed[name][1], 2)}
            )
    for name, sac in made.items():
        kernels = profiled(lambda sac=sac: sac.replay(PROFILED), device, PROFILED)
        profiles.append(f'### {task}, {name}\n\n{kernels}')
    return rows, '\n\n'.join(profiles)


def profiled(call: Callable[[], object], device: str, times: int) -> str:
    """The kernels of a call that does something so many times, the longest first."""
    activities = [ProfilerActivity.CPU]
    if device != 'cpu':
        activities.append(ProfilerActivity.CUDA)
    with profile(activities=activities) as trace:
        whole = seconds(call, device)
    kind = DeviceType.CPU if device == 'cpu' else DeviceType.CUDA
    time_of = 'self_cpu_time_total' if device == 'cpu' else 'self_device_time_total'
    kernels = [event for event in trace.key_averages() if event.device_type == kind]
    kernels.sort(key=lambda event: -getattr(event, time_of))
    busy = sum(getattr(event, time_of) for event in kernels) / times
    calls = sum(event.count for event in kernels) / times
    lines = [
        f'{calls:.0f} kernels and copies each time, {busy:.0f} us of {1e6 * whole / times:.0f} '
        'us (the profiler itself takes time).',
        '',
        '| kernel | each time | us each time | share |',
        '|---|---:|---:|---:|',
    ]
    for event in kernels[:TOP]:
        took = getattr(event, time_of) / times
        name = event.key[:90].replace('|', '/')
        lines.append(f'| `{name}` | {event.count / times:.1f} | {took:.1f} | {took / busy:.0%} |')
    return '\n'.join(lines)


def table(rows: list[dict[str, Any]]) -> list[str]:
    """A line for each size and form."""
    lines = [
        '| size | form | updates/s | of eager | phase [ms] | first [s] | made [s] |',
        '|---|---|---:|---:|---:|---:|---:|',
    ]
    eager: list[float] = []
    for task, form in dict.fromkeys((row['task'], row['form']) for row in rows):
        some = [row for row in rows if (row['task'], row['form']) == (task, form)]
        rates = [row['updates'] / row['seconds'] for row in some]
        eager = rates if form == 'eager' else eager  # the first form of each task
        ratios = [a / b for a, b in zip(rates, eager, strict=True)]
        phases = [1000 * row['phase_s'] for row in some]
        cells = [task, form, machine.spread(rates, '.0f'), machine.spread(ratios, '.2f')]
        cells.append(machine.spread(phases, '.1f'))
        cells += [f'{some[0][name]:.1f}' for name in ('first_s', 'made_s')]
        lines.append(f'| {" | ".join(cells)} |')
    return lines


def device_facts(device: str) -> dict[str, str]:
    """The name and versions of the GPU."""
    if device == 'cpu':
        return {'GPU': 'none: the numbers are those of a CPU'}
    return {
        'GPU': torch.cuda.get_device_name(device),
        'CUDA': str(torch.version.cuda),
        'float32 products': torch.get_float32_matmul_precision(),
    }


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--device', default='cuda')
    parser.add_argument('--steps', type=int, default=1_000_000, help='of the memory')
    parser.add_argument('--updates', type=int, default=2000, help='of a round')
    parser.add_argument('--rounds', type=int, default=5)
    parser.add_argument('--batch', type=int, default=256)
    parser.add_argument('--width', type=int, default=256)
    parser.add_argument('--only', nargs='+', choices=list(SIZES), help='some of the sizes')
    parser.add_argument('--out', type=Path, default=RESULTS)
    arguments = parser.parse_args()
    facts = machine.facts(machine.load(), ['torch', 'numpy']) | device_facts(arguments.device)
    rows, profiles = [], []
    for task in arguments.only or SIZES:
        some, text = measure(task, arguments)
        rows += some
        profiles.append(text)
        print('\n'.join(table(some)), flush=True)
        # after each, so that a later interruption loses nothing
        write(rows, profiles, facts, arguments)


def write(
    rows: list[dict[str, Any]],
    profiles: list[str],
    facts: dict[str, str],
    arguments: argparse.Namespace,
) -> None:
    """Write the CSV file of all rounds, the table and the facts of the machine."""
    arguments.out.mkdir(parents=True, exist_ok=True)
    with (arguments.out / 'rounds.csv').open('w', newline='') as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    (arguments.out / 'machine.json').write_text(json.dumps(facts, indent=2) + '\n')
    text = [
        '# SAC updates per second on a GPU, sampling included',
        '',
        f'{"; ".join(f"{name} {value}" for name, value in facts.items())}.',
        '',
        f'{arguments.steps} steps in the memory, batch {arguments.batch}, width '
        f'{arguments.width}, {arguments.rounds} rounds of {arguments.updates} updates. Median '
        'round [lowest, highest]. What is compared: `benchmarks/sac_gpu.py`.',
        '',
        *table(rows),
        '',
        f'## What is left, {PROFILED} updates each',
        '',
        '\n\n'.join(profiles),
    ]
    (arguments.out / 'table.md').write_text('\n'.join(text) + '\n')


if __name__ == '__main__':
    main()
