"""`codetr bag recover`: make a whole bag from what can be read."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console

from codetr_ros.cli import FAILED, refuse
from codetr_ros.cli.terminal import console, parse_arguments
from codetr_ros.runs import folder as run_folder

SHOWN = 20
"""Losses that are printed; `--json` has more."""


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Make a whole bag (index, metadata) from what can be read of a damaged or unfinished one.

    Every message that can be read is kept byte for byte, in order; every loss is printed. The old
    bag is not touched. Exit code 0: the new bag is sound, 1: something within it is missing, or
    the disk cannot read all of the old one, 2: nothing could be recovered.
    """

    bag: Annotated[
        Path,
        tyro.conf.Positional,
        tyro.conf.arg(metavar='BAG', help="the bag's folder or file, or the folder of a run"),
    ]
    out: Annotated[str, tyro.conf.arg(metavar='NEW', help='folder of the new bag')]
    json: Annotated[bool, tyro.conf.arg(help='print JSON', name='json')] = False


def main(arguments: Sequence[str]) -> int:
    """Recover and print; returns the exit code."""
    given = parse_arguments(
        Arguments,
        prog='codetr bag recover',
        arguments=arguments,
        config=(tyro.conf.FlagCreatePairsOff,),
    )
    from codetr_ros.bags.errors import BagError
    from codetr_ros.bags.recover import recover

    try:
        recovered = recover(run_folder.bag_of(given.bag), given.out)
    except BagError as error:
        return refuse(str(error))
    if given.json:
        print(json.dumps(recovered.report(), indent=2, allow_nan=False))
    else:
        show(recovered.report(), console())
    return 0 if recovered.whole else FAILED


def show(report: Mapping[str, Any], console: Console) -> None:
    """Print what became of the bag."""

    def show_line(text: str) -> None:
        console.print(text, highlight=False)

    for loss in report['losses'][:SHOWN]:
        lost = f' ({loss["bytes"]} bytes lost)' if loss['bytes'] else ''
        show_line(f'{loss["place"]}: {loss["text"]}{lost}')
    if report['faults'] > SHOWN:
        show_line(f'{report["faults"] - SHOWN} more')
    verdict = report['verdict']
    for finding in verdict['findings'][:SHOWN]:
        show_line(f'in the new bag: {finding["kind"]}: {finding["text"]}')
    if (more := sum(verdict['found'].values()) - SHOWN) > 0:
        show_line(f'{more} more in the new bag: `codetr bag verify {report["new"]}`')
    for remark in verdict['remarks']:
        show_line(f'note: {remark}')
    for run in verdict['runs']:
        if run['phases_committed']:
            whole = run['phases_whole']
            upto = f'whole up to phase {whole - 1}' if whole else 'no phase is whole'
            show_line(
                f'run {run["run_id"]!r} in {run["namespace"]}: {upto}, '
                f'{run["phases_committed"]} phases were committed'
            )
    unread = report['unread']
    show_line(
        f'{report["new"]}: {report["messages"]} messages, {report["bytes"]} bytes kept; '
        f'{report["bytes_lost"]} bytes of {report["old"]} could not be read'
        + (f', and the disk cannot be read in {unread} places' if unread else '')
    )
