"""Short runs, stage by stage: the effect of a GPU and of each switch.

    .venv/bin/python benchmarks/gpu_runs.py

All runs are made in one process (`codetr train --in-process` without its summary), with networks
of the paper's size on HalfCheetah-v5, and both SAC and the reward transformer on the device. A
round goes through all of them in turn, every other round backwards, as long as there is time for
another. Groups:
  - device: 2000 steps on the CPU with one thread, after the first round only, and on the device
  - options: 6000 steps: SAC's graph, the same compiled, bfloat16 (also with cuDNN's attention),
    256 segments labelled at a time

The recorded results have two more groups, of options that were removed because of them: steps of
Gymnasium's environments without their unread parts (`steps`), and threads for the environments of
a simulator (`threads`). See docs/decisions.

Columns: seconds from the first permission to simulate to the end, and those of each stage; `else`
is messages, policies and checkpoints. In process, evaluation takes its turn between two gradient
steps or bursts. So if a run is evaluated, `fit` and `update` hold some of its seconds a second
time, and `else` is left empty. `GPU busy` is the share of time in which the driver saw a kernel
run. The table gives the median round, and the lowest and highest in brackets.
"""

import argparse
import csv
import statistics
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch.nn.attention import SDPBackend

import machine
from codetr_ros.config import Settings, load
from codetr_ros.cores import in_process
from codetr_ros.records import Metrics, Policy, Record
from codetr_ros.rewards import transformer
from sac_gpu import device_facts

RESULTS = Path(__file__).parent / 'results' / 'gpu_check'
STAGES = ('simulate', 'fit', 'label', 'update')
"""The stages of a run, whose times are the metrics NAME_seconds."""
WORK = {'fit': 'gradient_steps', 'update': 'updates'}
SMALL = {'phase_steps': 100, 'codetr.layers': 1, 'codetr.embedding': 16, 'sac.hidden': (16,)}


@dataclass(frozen=True)
class Variant:
    """A run that is compared with the others of its group.

    Attributes:
        group: the runs that it is compared with.
        name: its difference from them.
        changes: of the settings.
        cudnn: whether cuDNN may do the reward transformer's attention.
        once: run after the first round only.
    """

    group: str
    name: str
    changes: dict[str, Any] = field(default_factory=dict)
    cudnn: bool = False
    once: bool = False


def variants(device: str) -> list[Variant]:
    """All runs of a round."""
    there = {'device': device, 'reward_device': device, 'codetr.label_batch': 4096}
    here = {'device': 'cpu', 'reward_device': 'cpu', 'sac.compile': True}
    short = {'steps': 2000}
    long = there | {'steps': 6000, 'evaluate_every': 0}
    rounded = long | {'codetr.precision': 'bfloat16'}
    return [
        Variant('device', 'CPU', short | here, once=True),
        Variant('device', device, short | there),
        Variant('options', 'graph', long),
        Variant('options', 'compiled graph', long | {'sac.compile': device != 'cpu'}),
        Variant('options', 'bfloat16', rounded),
        Variant('options', 'bfloat16, cuDNN', rounded, cudnn=True),
        Variant('options', '256 segments at a time', long | {'codetr.label_batch': 256}),
    ]


def settings_of(variant: Variant, smallest: bool) -> Settings:
    """The settings of a run."""
    usual = {'task': 'HalfCheetah-v5', 'warmup_steps': 1000, 'sac.compile': False}
    usual |= {'codetr.context': 'segment'}
    changes = usual | {'codetr.first_gradient_steps': 10, **variant.changes}
    if smallest:
        changes |= {**SMALL, 'steps': 300, 'warmup_steps': 100, 'sac.compile': False}
        changes |= {'codetr.first_gradient_steps': 2, 'evaluate_episodes': 1}
    return load('paper').changed(changes)


class Watch:
    """Measures a run by its records and the clock, and samples the GPU while it runs."""

    def __init__(self, device: str) -> None:
        self.began: float | None = None
        self.totals: Counter[str] = Counter()
        self._latest: dict[str, float] = {}
        self._device, self._busy = device, list[float]()
        self._over = threading.Event()

    def receive(self, record: Record) -> None:
        """Note the first permission, and the metrics of the stages."""
        if isinstance(record, Policy) and self.began is None:
            self.began = time.perf_counter()
        if isinstance(record, Metrics):
            for name, value in zip(record.names, record.values.tolist(), strict=True):
                self._latest[name] = value
                if name.endswith('_seconds') or name == 'steps_labelled':
                    self.totals[name] += value

    @contextmanager
    def sampling(self) -> Iterator[None]:
        """Ask the driver ten times a second how busy the GPU is, if NVML is there."""
        thread = threading.Thread(target=self._sample, daemon=True)
        if self._device != 'cpu':
            thread.start()
        try:
            yield
        finally:
            self._over.set()
            if self._device != 'cpu':
                thread.join()

    def _sample(self) -> None:
        while not self._over.wait(0.1):
            if self.began is None:
                continue
            try:
                self._busy.append(torch.cuda.utilization(self._device))
            except (ModuleNotFoundError, RuntimeError):  # no NVML for Python
                return

    def row(self) -> dict[str, float | str]:
        """The measurements, once the run is over."""
        assert self.began is not None
        row: dict[str, float | str] = {'seconds': time.perf_counter() - self.began}
        row |= {stage: self.totals[f'{stage}_seconds'] for stage in STAGES}
        row |= {name: self._latest.get(name, 0.0) for name in WORK.values()}
        row['steps_labelled'] = self.totals['steps_labelled']
        row['gpu_busy'] = statistics.mean(self._busy) / 100 if self._busy else ''
        return row


@contextmanager
def switched(variant: Variant) -> Iterator[None]:
    """Switch the library to a variant for a while."""
    kernels = list(transformer.KERNELS)
    if variant.cudnn:
        transformer.KERNELS.append(SDPBackend.CUDNN_ATTENTION)
    try:
        yield
    finally:
        transformer.KERNELS[:] = kernels


def one_run(variant: Variant, device: str, smallest: bool) -> dict[str, float | str]:
    """Do one run of a variant; returns its measurements."""
    settings, watch = settings_of(variant, smallest), Watch(device)
    with switched(variant), tempfile.TemporaryDirectory() as folder, watch.sampling():
        reports = in_process.run(settings, 'run', Path(folder), watch.receive)
        row = watch.row()
    row['evaluate'] = reports['evaluate'].cpu_s
    used = sum(float(row[stage]) for stage in STAGES)
    row['else'] = '' if settings.evaluate_every else float(row['seconds']) - used
    return {'steps': settings.steps} | row


def table(rows: list[dict[str, Any]]) -> list[str]:
    """A line for each variant, group by group."""
    columns = ('seconds', *STAGES, 'evaluate', 'else')
    head = ['group', 'run', 'steps', *columns, 'ms a gradient step', 'updates/s', 'labels/s']
    lines = [
        f'| {" | ".join([*head, "GPU busy"])} |',
        '|---|---' + (len(head) - 1) * '|---:' + '|',
    ]
    for group, name in dict.fromkeys((row['group'], row['run']) for row in rows):
        some = [row for row in rows if (row['group'], row['run']) == (group, name)]
        cells = [group, name, str(some[0]['steps'])]
        for column in columns:
            values = [row[column] for row in some if row[column] != '']
            cells.append(machine.spread(values, '.2f') if values else '')
        for stage, work, form in (
            ('fit', 'gradient_steps', '.1f'),
            ('update', 'updates', '.0f'),
            ('label', 'steps_labelled', '.0f'),
        ):
            rates = [row[work] / row[stage] for row in some if row[stage]]
            values = [1000 / rate for rate in rates] if stage == 'fit' else rates
            cells.append(f'{statistics.median(values):{form}}' if values else '')
        busy = [row['gpu_busy'] for row in some if row['gpu_busy'] != '']
        cells.append(f'{statistics.median(busy):.0%}' if busy else '')
        lines.append(f'| {" | ".join(cells)} |')
    return lines


def write(rows: list[dict[str, Any]], facts: dict[str, str], out: Path) -> None:
    """Write the CSV file of all runs, and the table."""
    out.mkdir(parents=True, exist_ok=True)
    with (out / 'runs.csv').open('w', newline='') as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        for row in rows:
            numbers = {k: round(v, 4) if isinstance(v, float) else v for k, v in row.items()}
            writer.writerow(numbers)
    lines = ['# Short runs, stage by stage', '']
    lines += [f'- {name}: {value}' for name, value in facts.items()]
    lines += ['', 'Median round [lowest, highest]. What is compared: `benchmarks/gpu_runs.py`.']
    (out / 'runs.md').write_text('\n'.join([*lines, '', *table(rows)]) + '\n')


def main() -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--device', default='cuda')
    parser.add_argument(
        '--seconds', type=float, default=205, help='begin no round that would end later'
    )
    parser.add_argument('--rounds', type=int, default=5, help='at most')
    parser.add_argument(
        '--groups', nargs='+', metavar='GROUP', help='run only the groups that begin with this'
    )
    parser.add_argument('--smallest', action='store_true', help='only show that it works')
    parser.add_argument('--out', type=Path, default=RESULTS)
    arguments = parser.parse_args()
    device, smallest = arguments.device, arguments.smallest
    facts = machine.facts(machine.load(), ('torch', 'numpy', 'mujoco')) | device_facts(device)
    chosen = [
        variant
        for variant in variants(device)
        if any(map(variant.group.startswith, arguments.groups or ['']))
    ]
    began = time.monotonic()
    # not counted: the set-up of libraries at their first use
    one_run(Variant('', '', chosen[-1].changes), device, smallest=True)
    rows: list[dict[str, Any]] = []

    def go(variant: Variant, n: int) -> None:
        took = one_run(variant, device, smallest)
        rows.append({'group': variant.group, 'run': variant.name, 'round': n} | took)
        print(variant.group, variant.name, f'{took["seconds"]:.2f} s', flush=True)
        write(rows, facts, arguments.out)

    repeated = [variant for variant in chosen if not variant.once]
    for n in range(1 if smallest else arguments.rounds):
        before = time.monotonic()
        for variant in repeated[:: -1 if n % 2 else 1]:
            go(variant, n)
        a_round = time.monotonic() - before
        for variant in chosen:
            if variant.once and n == 0:
                go(variant, n)
        if time.monotonic() - began + a_round > arguments.seconds:
            break
    print('\n'.join(table(rows)))
    return 0


if __name__ == '__main__':
    sys.exit(main())
