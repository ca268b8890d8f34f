"""Check and measure all that needs a GPU, in one command and under eight minutes, without ROS.

    .venv/bin/python benchmarks/gpu_check.py

The steps, each with a time limit of its own:
  - tests: those of the device paths, `tests/*/test_*device*.py`, including the slow ones
  - command: `codetr train --in-process --device cuda --reward-device cuda`, as users type it
  - sac: `sac_gpu.py`, updates per second: eager, replayed, compiled and replayed
  - codetr: `codetr_speed.py`, gradient steps and labels per second, in float32 and bfloat16
  - profile: `gpu_profile.py`, the work of host and GPU in a short run
  - label_batches: the same labels, more or fewer at a time
  - runs: `gpu_runs.py`, short runs, stage by stage: beside a CPU, and with one thing changed

Each step writes its measurements at once, and `check.md` follows after each step. So if one fails
or is cut off, or the `--seconds` of all of them are over, the others' results are there. The exit
code is 0 only if every step ended by itself and no test failed.

Without a GPU this shows in some minutes that the script works, and nothing about a GPU:

    .venv/bin/python benchmarks/gpu_check.py --device cpu --smallest --out /tmp/gpu_check
"""

import argparse
import csv
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import machine
from sac_gpu import device_facts

HERE = Path(__file__).resolve().parent
TESTS = HERE.parent / 'tests'
RESULTS = HERE / 'results' / 'gpu_check'
PACKAGES = ('torch', 'numpy', 'mujoco', 'gymnasium')
LEAST = 5.0
"""No step begins with fewer seconds left."""


@dataclass(frozen=True)
class Step:
    """A command that measures something.

    Attributes:
        name: of the step and of its log.
        command: the arguments of Python.
        limit: seconds after which it is ended.
        results: the file with its numbers, in the folder of the results.
    """

    name: str
    command: Sequence[str]
    limit: float
    results: str


@dataclass(frozen=True)
class Outcome:
    """The ending of a step."""

    step: Step
    ending: str
    seconds: float

    @property
    def done(self) -> bool:
        """Whether it ended by itself without an error."""
        return self.ending == 'done'


def steps(device: str, smallest: bool, out: Path) -> list[Step]:
    """The steps of a check, in order.

    Args:
        device: the device to measure.
        smallest: only show that the scripts work.
        out: the folder of the results.
    """
    tests = sorted(map(str, TESTS.glob('*/test_*device*.py')))
    pytest = ['-m', 'pytest', *tests, '-q', '-p', 'no:cacheprovider']
    train = ['-m', 'codetr_ros.cli', 'train', '--in-process', '--device', device]
    train += ['--reward-device', device, '--config', 'quick', '--out', str(out / 'logs' / 'run')]
    sac = ['sac_gpu.py', '--device', device, '--out', str(out / 'sac'), '--rounds', '3']
    codetr = ['codetr_speed.py', '--device', device, '--threads', '1', '--rounds', '3']
    labels = [*codetr, '--delays', '25', '--precisions', 'float32']
    if smallest:
        train += ['--steps', '2000', '--evaluate-every', '0']
        sac += ['--only', 'HalfCheetah', '--steps', '3000', '--updates', '3']
        codetr += ['--delays', '5', '--precisions', 'float32']
        labels += ['--label-batches', '64', '256']
    else:
        train += ['--steps', '6000']
        sac += ['--only', 'HalfCheetah', 'Ant 105', '--updates', '500']
        codetr += ['--delays', '25', '100']
        labels += ['--label-batches', '256', '16384', '--part-mib', '128', '1024']
    small = ['--smallest'] if smallest else []
    runs = ['gpu_runs.py', '--device', device, '--out', str(out), *small]
    profile = ['gpu_profile.py', '--device', device, '--out', str(out), *small]
    return [
        Step('tests', [*pytest, f'--junit-xml={out / "logs" / "tests.xml"}'], 120, 'tests.csv'),
        Step('command', train, 60, ''),
        Step('sac', sac, 100, 'sac/table.md'),
        Step('codetr', [*codetr, '--out', str(out / 'codetr')], 90, 'codetr.md'),
        Step('profile', profile, 60, 'profile.md'),
        Step(
            'label_batches', [*labels, '--out', str(out / 'label_batches')], 45, 'label_batches.md'
        ),
        Step('runs', runs, 240, 'runs.md'),
    ]


def run(step: Step, seconds: float, out: Path) -> Outcome:
    """Run a step for as long as it may; its output goes to its log.

    Args:
        step: the step.
        seconds: left for it and all steps after it.
        out: the folder of the results.
    """
    limit = min(step.limit, seconds)
    if limit < LEAST:
        return Outcome(step, f'left out: {max(0.0, seconds):.0f} s were left', 0.0)
    log = out / 'logs' / f'{step.name}.log'
    log.parent.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    with log.open('wb') as file:
        process = subprocess.Popen(
            [sys.executable, *step.command],
            cwd=HERE,
            stdout=file,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        try:
            code = process.wait(limit)
            ending = 'done' if code == 0 else f'failed with exit code {code}, see its log'
        except subprocess.TimeoutExpired:
            ending = f'cut off after {limit:.0f} s'
        finally:
            with suppress(ProcessLookupError):  # ends everything that the step has started
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    return Outcome(step, ending, time.monotonic() - began)


def tests_of(report: Path) -> list[dict[str, str]]:
    """The outcome of each test, from pytest's report."""
    rows = []
    for case in ElementTree.parse(report).getroot().iter('testcase'):
        kinds = {child.tag: child for child in case}
        ended = next((kind for kind in ('error', 'failure', 'skipped') if kind in kinds), '')
        why = kinds[ended].get('message', '').splitlines()[:1] if ended else []
        rows.append(
            {'file': case.get('classname', ''), 'test': case.get('name', '')}
            | {'outcome': ended or 'passed', 'seconds': case.get('time', ''), 'why': ''.join(why)}
        )
    return rows


def write(outcomes: list[Outcome], facts: dict[str, str], out: Path) -> None:
    """Write the table of the steps done until now, and of the tests."""
    lines = ['# What only a GPU can show', '']
    lines += [f'- {name}: {value}' for name, value in facts.items()]
    lines += ['', '| step | ended | s | numbers |', '|---|---|---:|---|']
    for outcome in outcomes:
        file = outcome.step.results
        link = f'[{file}]({file})' if file and (out / file).is_file() else ''
        lines.append(
            f'| {outcome.step.name} | {outcome.ending} | {outcome.seconds:.0f} | {link} |'
        )
    if (report := out / 'logs' / 'tests.xml').is_file():
        rows = tests_of(report)
        with (out / 'tests.csv').open('w', newline='') as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)
        counts = Counter(row['outcome'] for row in rows)
        lines += ['', 'Tests: ' + ', '.join(f'{n} {name}' for name, n in counts.items()) + '.']
        lines += [
            f'- {row["outcome"]}: `{row["test"]}`: {row["why"]}'
            for row in rows
            if row['outcome'] != 'passed'
        ]
    lines += ['', 'The load average that a later step names is that of the steps before it.']
    (out / 'check.md').write_text('\n'.join(lines) + '\n')


def check(planned: list[Step], seconds: float, facts: dict[str, str], out: Path) -> list[Outcome]:
    """Take all steps for which there is time, and write the results after each."""
    out.mkdir(parents=True, exist_ok=True)
    ends = time.monotonic() + seconds
    outcomes: list[Outcome] = []
    for step in planned:
        print(f'{step.name} ...', flush=True)
        outcomes.append(run(step, ends - time.monotonic(), out))
        write(outcomes, facts, out)
        print(f'{step.name}: {outcomes[-1].ending} ({outcomes[-1].seconds:.0f} s)', flush=True)
    return outcomes


def main() -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--device', default='cuda')
    parser.add_argument('--seconds', type=float, default=470, help='for all steps together')
    parser.add_argument('--smallest', action='store_true', help='only show that it works')
    parser.add_argument('--only', nargs='+', metavar='STEP', help='some of the steps')
    parser.add_argument('--out', type=Path, default=RESULTS)
    arguments = parser.parse_args()
    out = arguments.out.resolve()
    planned = steps(arguments.device, arguments.smallest, out)
    names = [step.name for step in planned]
    if unknown := set(arguments.only or []) - set(names):
        parser.error(f'--only {" ".join(sorted(unknown))}: the steps are {", ".join(names)}')
    facts = machine.facts(machine.load(), PACKAGES) | device_facts(arguments.device)
    facts['command'] = ' '.join(sys.argv)
    chosen = [step for step in planned if step.name in (arguments.only or names)]
    outcomes = check(chosen, arguments.seconds, facts, out)
    print((out / 'check.md').read_text())
    return 0 if all(outcome.done for outcome in outcomes) else 1


if __name__ == '__main__':
    sys.exit(main())
