"""`codetr bag verify`: is a bag sound?"""

import dataclasses
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console

from codetr_ros.cli import FAILED, refuse
from codetr_ros.cli.terminal import console, parse_arguments
from codetr_ros.runs import folder as run_folder

MENDED = {'file', 'index', 'metadata'}
"""Kinds of findings that `codetr bag recover` mends."""


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Compare everything in a bag that can be compared. Exit code 0: sound, 1: damaged, 2: no bag.

    It reports damaged or cut off chunks and files, messages that are missing or come twice,
    numbers that are not finite, segments without their score, commits of missing records, mixed
    runs, and indexes and metadata that are wrong.
    """

    bag: Annotated[
        Path,
        tyro.conf.Positional,
        tyro.conf.arg(metavar='BAG', help="the bag's folder or file, or the folder of a run"),
    ]
    json: Annotated[bool, tyro.conf.arg(help='print JSON', name='json')] = False
    limit: Annotated[
        int, tyro.conf.arg(metavar='N', help='the most findings of each kind to print')
    ] = 20


def main(arguments: Sequence[str]) -> int:
    """Read, compare and print; returns the exit code."""
    given = parse_arguments(
        Arguments,
        prog='codetr bag verify',
        arguments=arguments,
        config=(tyro.conf.FlagCreatePairsOff,),
    )
    from codetr_ros.bags.errors import BagError
    from codetr_ros.bags.verify import verify

    try:
        verdict = verify(run_folder.bag_of(given.bag))
    except BagError as error:
        return refuse(str(error))
    if given.json:
        print(json.dumps(verdict.report(), indent=2, allow_nan=False))
    else:
        show(verdict.report(), given.limit, console())
    return 0 if verdict.sound else FAILED


def show(report: Mapping[str, Any], limit: int, console: Console) -> None:
    """Print the findings of `verify`."""
    shown: Counter[str] = Counter()
    for finding in report['findings']:
        shown[finding['kind']] += 1
        if shown[finding['kind']] <= limit:
            text = f'{finding["kind"]}: {finding["place"]}: {finding["text"]}'
            console.print(text, highlight=False)
    for kind, count in report['found'].items():
        if (more := count - min(shown[kind], limit)) > 0:  # the report lists a limited number
            console.print(f'{kind}: {more} more', highlight=False)
    for remark in report['remarks']:
        console.print(f'note: {remark}', highlight=False)
    for run in report['runs']:
        committed, whole = run['phases_committed'], run['phases_whole']
        if committed:
            text = f'run {run["run_id"]!r} in {run["namespace"]}: {committed} phases committed'
            last = f', whole up to phase {whole - 1}' if whole else ', none of them whole'
            text += ', all whole' if whole == committed else last
            console.print(text, highlight=False)
    total = sum(report['found'].values())
    if total:
        kinds = ', '.join(f'{count} {kind}' for kind, count in report['found'].items())
        console.print(
            f'{report["bag"]}: damaged: {total} findings ({kinds}) in {report["messages"]} '
            f'messages. {_remedy(report)}',
            style='red',
            highlight=False,
        )
    else:
        text = f'{report["bag"]}: sound, {report["messages"]} messages'
        console.print(text, style='green')


def _remedy(report: Mapping[str, Any]) -> str:
    """What can be done about the findings. Only faults of files can be mended: what is missing in
    whole files is not on the disk, and `recover` invents nothing.
    """
    if MENDED & set(report['found']):
        return (
            f'`codetr bag recover {report["bag"]} --out NEW` makes a whole bag from what can be '
            'read'
        )
    return (
        'Its files are whole, so `codetr bag recover` has nothing to mend: look for another '
        'recording of what is missing'
    )
