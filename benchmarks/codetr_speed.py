"""How fast does CoDeTr learn and label, and how fast could it be?

    .venv/bin/python benchmarks/codetr_speed.py                       # on an idle machine
    .venv/bin/python benchmarks/codetr_speed.py --delays 25 100 --threads 1 --rounds 3
    .venv/bin/python benchmarks/codetr_speed.py --device cuda --threads 1 --out codetr_speed_cuda

The reward transformer has the size of the preset `paper`, the steps those of Ant (27 observations,
8 actions). Measured are, for each delay n:
  - gradient: one gradient step of the reward node, with its batch drawn from the memory
  - label: the reward node's labelling of whole segments of the memory

Each is compared with its floor: the floating point operations that it needs
(`codetr_ros.rewards.cost`), at the rate that products of matrices of the same precision reach in
the same round. That rate is the higher one of two shapes: 256x256 by 256x256, and the tokens of 64
segments of 25 steps by the MLP's weights. A ratio of 1 is as fast as the products alone. `as
written` is the same ratio with the operations of a plainly written network, which has tokens that
are never read and products that are then masked; our network leaves out both. Rounds go through
everything in turn; the table gives the median round, and the lowest and highest in brackets.

On a GPU (`--device cuda`) 4096x4096 by 4096x4096 replaces the first shape, because such small ones
reach little there. A memory of a million steps is labelled whole, 4096 segments at a time, or as
many as each of `--label-batches`, in parts whose activations take a gigabyte, or as much as each
of `--part-mib`. The batches that it learns from are made on the CPU.

`--clock cpu` counts the processor's working time instead of wall time: for one thread on a machine
that does other things as well.
"""

import argparse
import csv
import itertools
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

import machine
from codetr_ros.config import Settings, load
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import CompositeReward, Transitions
from codetr_ros.rewards import sequence
from codetr_ros.rewards.codetr import Codetr
from codetr_ros.seeding import generator, seed_torch
from cost import Cost

RESULTS = Path(__file__).parent / 'results'
OBSERVATION, ACTION = 27, 8  # Ant
DELAYS = (5, 25, 50, 100, 200, 500)
EPISODE = 1000
EPISODES, EPISODES_ON_GPU = 64, 1000
LABELLED = 6400  # steps, or 64 segments where these are more
SHAPES = (256, 256, 256), (64 * 50, 256, 1024)
LARGE = 4096, 4096, 4096  # for a GPU


def memory(delay: int, episodes: int) -> Trajectories:
    """Scored episodes of random steps."""
    scored = Trajectories(OBSERVATION, ACTION, delay, EPISODE * episodes, EPISODE)
    rng = np.random.default_rng(0)
    for n in range(episodes):
        observations = rng.standard_normal((EPISODE + 1, OBSERVATION), np.float32)
        actions = rng.uniform(-1, 1, (EPISODE, ACTION)).astype(np.float32)
        scored.append(
            Transitions(
                run_id='run',
                source='sim',
                sequence=n,
                phase=n,
                episode=n,
                first_step=0,
                steps=EPISODE,
                observations=observations,
                actions=actions,
                terminated=False,
                truncated=True,
                phase_end=True,
                scores_due=1,
            )
        )
        for first in range(0, EPISODE, delay):
            value = float(rng.standard_normal())
            scored.score(
                CompositeReward(
                    run_id='run',
                    source='sim',
                    scorer='sim',
                    sequence=first,
                    episode=n,
                    first_step=first,
                    length=delay,
                    value=value,
                )
            )
    return scored


class Work:
    """The work that is measured for one delay."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        on_cpu = settings.reward_device == 'cpu'
        self.memory = memory(settings.delay, EPISODES if on_cpu else EPISODES_ON_GPU)
        self.model = Codetr(settings, OBSERVATION, ACTION)
        self.model.prepare(self.memory)
        segments = max(LABELLED // settings.delay, 64)
        ids = self.memory.segments.ids()
        self.ids = ids[:segments] if on_cpu else ids
        self.steps = 0

    def gradient(self) -> tuple[int, int]:
        """Take a gradient step; returns its operations, and those of the plain form."""
        seed_torch(0, 'reward', self.steps)
        self.model.gradient_step(self.memory, generator(0, 'reward', self.steps))
        self.steps += 1
        needed, plain = self._costs(self.settings.codetr.batch)
        return needed.gradient, plain.gradient

    def label(self) -> tuple[int, int]:
        """Label some segments; returns their operations, and those of the plain form."""
        for i in range(0, len(self.ids), self.model.label_batch):
            some = self.ids[i : i + self.model.label_batch]
            for _ in self.model.label_passes(self.memory, some):
                pass
        needed, plain = self._costs(len(self.ids))
        return needed.forward, plain.forward

    def _costs(self, segments: int) -> tuple[Cost, Cost]:
        settings = self.settings
        size = settings.codetr, OBSERVATION, ACTION, segments, settings.delay
        return Cost(*size), Cost(*size, plain=True)


def products(device: torch.device, precision: str) -> float:
    """Operations per second of matrix products in a precision."""
    best = 0.0
    options: dict[str, Any] = {'device': device, 'dtype': getattr(torch, precision)}
    on_gpu = device.type != 'cpu'
    for rows, inner, columns in (SHAPES[1], LARGE) if on_gpu else SHAPES:
        a = torch.randn(rows, inner, **options)
        b = torch.randn(inner, columns, **options)
        out = torch.empty(rows, columns, **options)
        flops = 2 * rows * inner * columns
        times = max(1, round((2e12 if on_gpu else 5e9) / flops))
        torch.mm(a, b, out=out)
        wait(device)
        began = CLOCKS[clock]()
        for _ in range(times):
            torch.mm(a, b, out=out)
        wait(device)
        best = max(best, times * flops / (CLOCKS[clock]() - began))
    return best


def wait(device: torch.device) -> None:
    """Wait until the device has finished its work."""
    if device.type != 'cpu':
        torch.accelerator.synchronize(device)


CLOCKS: dict[str, Callable[[], float]] = {'wall': time.perf_counter, 'cpu': time.process_time}
clock = 'wall'


def measure(options: tuple[Any, ...], rounds: int, device: str) -> list[dict[str, Any]]:
    """Do all rounds with some options, given in the order of `OPTIONS`."""
    delay, threads, precision, label_batch, part_mib = options
    torch.set_num_threads(threads)
    sequence.DEVICE_PART_BYTES = part_mib << 20
    changes: dict[str, Any] = {'delay': delay, 'threads': threads, 'codetr.precision': precision}
    changes |= {'reward_device': device, 'codetr.label_batch': label_batch}
    work = Work(load('paper').changed({'codetr.context': 'segment'} | changes))
    where = work.model.device
    tasks: dict[str, tuple[Callable[[], tuple[int, int]], int]] = {
        'gradient': (work.gradient, 1),
        'label': (work.label, len(work.ids) * delay),
    }
    for task, _ in tasks.values():
        task()  # not counted
        wait(where)
    rows = []
    for n in range(rounds):
        for name, (task, units) in tasks.items():
            before = products(where, precision)
            began = CLOCKS[clock]()
            flops, plain = task()
            wait(where)
            seconds = CLOCKS[clock]() - began
            # a virtual machine's speed changes within seconds
            floor = (before + products(where, precision)) / 2
            rows.append(
                dict(zip(OPTIONS, options, strict=True))
                | {'what': name, 'round': n}
                | {'seconds': round(seconds, 5), 'units': units, 'flops': flops}
                | {'products_gflops': round(floor / 1e9, 2)}
                | {'ratio': round(flops / seconds / floor, 4)}
                | {'plain_ratio': round(plain / seconds / floor, 4)}
            )
    print(line(rows), flush=True)
    return rows


OPTIONS = ('delay', 'threads', 'precision', 'label_batch', 'part_mib')
HEAD = (
    '| n | threads | precision | labelled at a time | part [MiB] | products [GFLOP/s] '
    '| gradient steps/s | of the floor | as written '
    '| labelled steps/s | of the floor | as written |\n' + 12 * '|---' + '|'
)


def line(rows: list[dict[str, Any]]) -> str:
    """The table's line for the rounds of some options."""
    cells = [str(rows[0][name]) for name in OPTIONS]
    cells.append(f'{statistics.median(row["products_gflops"] for row in rows):.0f}')
    for what in ('gradient', 'label'):
        mine = [row for row in rows if row['what'] == what]
        rate = statistics.median(row['units'] / row['seconds'] for row in mine)
        cells.append(f'{rate:.2f}' if what == 'gradient' else f'{rate:.0f}')
        for kind in ('ratio', 'plain_ratio'):
            cells.append(machine.spread([row[kind] for row in mine], '.2f'))
    return f'| {" | ".join(cells)} |'


def write(rows: list[dict[str, Any]], out: Path, facts: dict[str, str]) -> None:
    """Write the CSV file of all rounds, and the table."""
    with out.with_suffix('.csv').open('w', newline='') as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    of: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in rows:
        of.setdefault(tuple(row[name] for name in OPTIONS), []).append(row)
    text = ['# Gradient steps and labels of CoDeTr per second', '']
    text += [f'- {name}: {value}' for name, value in facts.items()]
    text += ['', 'Median round [lowest, highest]. What is measured: `benchmarks/codetr_speed.py`.']
    text += ['', HEAD, *map(line, of.values())]
    out.with_suffix('.md').write_text('\n'.join(text) + '\n')


def main() -> None:
    """The command line."""
    global clock  # noqa: PLW0603
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--delays', type=int, nargs='+', default=DELAYS)
    parser.add_argument('--threads', type=int, nargs='+', default=[1, 2])
    parser.add_argument('--precisions', nargs='+', default=['float32', 'bfloat16'])
    parser.add_argument('--label-batches', type=int, nargs='+', help='256 on a CPU, else 4096')
    parser.add_argument('--part-mib', type=int, nargs='+', default=[1024], help='on a GPU only')
    parser.add_argument('--rounds', type=int, default=7)
    parser.add_argument('--clock', choices=list(CLOCKS), default='wall')
    parser.add_argument('--device', default='cpu', help='cpu, cuda, cuda:1, ...')
    parser.add_argument('--out', default='codetr_speed', help='name of the results')
    arguments = parser.parse_args()
    clock = arguments.clock
    load_before = machine.load()
    facts = machine.facts(load_before, ('torch', 'numpy'))
    if arguments.device != 'cpu':
        facts['device'] = torch.cuda.get_device_name(arguments.device)
    facts |= {'clock': clock, 'rounds': str(arguments.rounds), 'command': ' '.join(sys.argv)}
    print(HEAD, flush=True)
    rows = []
    label_batches = arguments.label_batches or [256 if arguments.device == 'cpu' else 4096]
    lists = (arguments.threads, arguments.delays, arguments.precisions, label_batches)
    for threads, delay, *others in itertools.product(*lists, arguments.part_mib):
        options = (delay, threads, *others)
        rows += measure(options, arguments.rounds, arguments.device)
        # after each, so that a later interruption loses nothing
        write(rows, RESULTS / arguments.out, facts)


if __name__ == '__main__':
    main()
