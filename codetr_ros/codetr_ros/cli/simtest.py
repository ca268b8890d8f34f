"""`codetr simtest`: whole runs in a simulated world that fails by a seed."""

import dataclasses
import json
import re
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from codetr_ros.cli import FAILED, refuse
from codetr_ros.cli.terminal import console, parse_arguments

if TYPE_CHECKING:
    from codetr_ros.simtest.run import Outcome

MOST_SHOWN = 20
"""The most failing seeds that are printed with their failures; all are counted."""


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Simulate whole runs in one process, in virtual time, with troubles drawn from a seed.

    Messages come late, twice, out of order or never; nodes stall, are killed and come back, or do
    not reach each other; disks are full or fail to sync. A run must end with the weights of the
    undisturbed run, or with an error that names its cause. A seed always gives the same run. Exit
    code 0: all of that held, 1: it did not.
    """

    seed: Annotated[
        int | None, tyro.conf.arg(metavar='N', help='simulate this seed, and print what it draws')
    ] = None
    seeds: Annotated[
        str | None, tyro.conf.arg(metavar='A:B', help='simulate the seeds from A up to B - 1')
    ] = None
    trace: Annotated[
        bool, tyro.conf.arg(help='print the newest events of the run, also if nothing failed')
    ] = False
    events: Annotated[
        int, tyro.conf.arg(metavar='N', help='the most events to print of a run')
    ] = 60
    json: Annotated[bool, tyro.conf.arg(help='print JSON', name='json')] = False


def main(arguments: Sequence[str]) -> int:
    """Simulate and print; returns the exit code."""
    given = parse_arguments(
        Arguments,
        prog='codetr simtest',
        arguments=arguments,
        config=(tyro.conf.FlagCreatePairsOff,),
    )
    if (given.seed is None) == (given.seeds is None):
        return refuse('give --seed N for one run, or --seeds A:B for many')
    if given.events < 1:
        return refuse(f'--events {given.events}: a run has at least 1 event')
    if given.seed is not None:
        return _one(given.seed, given)
    span = re.fullmatch(r'(\d+):(\d+)', given.seeds or '')
    if span is None or int(span[1]) >= int(span[2]):
        return refuse(f'--seeds {given.seeds}: give two numbers, the smaller first: 0:100')
    return _many(range(int(span[1]), int(span[2])), given)


def _one(seed: int, given: Arguments) -> int:
    from codetr_ros.simtest.run import simulate

    outcome = simulate(seed, given.events)
    if given.json:
        print(json.dumps(_report(outcome), indent=2))
    else:
        show(outcome, given.trace)
    return FAILED if outcome.failures else 0


def _report(outcome: 'Outcome') -> dict[str, Any]:
    return {
        'seed': outcome.plan.seed,
        'plan': outcome.plan.in_words(),
        'failures': outcome.failures,
        'gave_up': outcome.errors,
        'virtual_seconds': outcome.seconds,
        'trace': outcome.trace,
    }


def show(outcome: 'Outcome', trace: bool) -> None:
    """Print how a simulated run ended."""
    terminal = console()

    def line(text: str, style: str | None = None) -> None:
        terminal.print(text, style=style, highlight=False, markup=False, soft_wrap=True)

    for text in outcome.plan.in_words():
        line(text)
    if trace or outcome.failures:
        for text in outcome.trace:
            line(text)
    for name, error in outcome.errors.items():
        line(f'{name} gave up: {error}')
    for text in outcome.failures:
        line(f'seed {outcome.plan.seed}: {text}', 'red')
    if not outcome.failures:
        line(
            f'seed {outcome.plan.seed}: sound after {outcome.seconds:.1f} s of virtual time',
            'green',
        )


def _many(seeds: range, given: Arguments) -> int:
    from codetr_ros.simtest.run import simulate

    terminal = console()
    began = time.perf_counter()
    failed: list[dict[str, Any]] = []
    gave_up = mended = 0
    for seed in seeds:
        outcome = simulate(seed, given.events)
        gave_up += bool(outcome.errors)
        mended += not outcome.errors and not outcome.plan.calm
        if outcome.failures:
            failed.append({'seed': seed, 'failures': outcome.failures})
            if not given.json and len(failed) <= MOST_SHOWN:
                text = f'seed {seed}: {outcome.failures[0]}'
                terminal.print(text, style='red', highlight=False, markup=False, soft_wrap=True)
    seconds = time.perf_counter() - began
    report = {
        'seeds': len(seeds),
        'first': seeds.start,
        'failed': failed,
        'troubled_and_mended': mended,
        'ended_by_a_named_cause': gave_up,
        'seconds': round(seconds, 1),
    }
    if given.json:
        print(json.dumps(report, indent=2))
    else:
        terminal.print(
            f'{len(seeds)} seeds in {seconds:.0f} s: {len(failed)} failed, {mended} with troubles '
            f'ended as if nothing had happened, {gave_up} by an error that names its cause',
            style='red' if failed else 'green',
            highlight=False,
        )
    return FAILED if failed else 0
