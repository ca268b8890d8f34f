"""`codetr bag info`: what is in a bag, as tables."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.table import Table

from codetr_ros.cli import refuse
from codetr_ros.cli.terminal import console, parse_arguments
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs.numbers import exact


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Show what is in a bag. It is read from end to end; damage is counted and skipped."""

    bag: Annotated[
        Path,
        tyro.conf.Positional,
        tyro.conf.arg(metavar='BAG', help="the bag's folder or file, or the folder of a run"),
    ]
    json: Annotated[bool, tyro.conf.arg(help='print JSON', name='json')] = False


def main(arguments: Sequence[str]) -> int:
    """Read and print; returns the exit code."""
    given = parse_arguments(
        Arguments,
        prog='codetr bag info',
        arguments=arguments,
        config=(tyro.conf.FlagCreatePairsOff,),
    )
    from codetr_ros.bags.errors import BagError
    from codetr_ros.bags.info import survey

    try:
        contents = survey(run_folder.bag_of(given.bag))
    except BagError as error:
        return refuse(str(error))
    if given.json:
        print(json.dumps(contents, indent=2, allow_nan=False))
    else:
        show(contents, console(tables=True))
    return 0


def show(contents: Mapping[str, Any], console: Console) -> None:
    """Print the contents that `survey` returns."""
    console.print(_bag(contents))
    for run in contents['runs']:
        console.print()
        console.print(_run(run))
    console.print()
    console.print(_topics(contents['topics']))
    if contents['faults']:
        console.print(
            f'\n{contents["faults"]} faults were skipped: `codetr bag verify {contents["bag"]}` '
            'lists them',
            style='yellow',
            highlight=False,
        )


def _pairs() -> Table:
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column(no_wrap=True)
    table.add_column(overflow='fold')
    return table


def _bag(contents: Mapping[str, Any]) -> Table:
    table = _pairs()
    table.add_row('bag', contents['bag'])
    for file in contents['files']:
        table.add_row('file', f'{file["name"]}, {file["bytes"] / 1e6:.2f} MB')
    first, last = contents['first_ns'], contents['last_ns']
    if first is not None:
        for name, time in (('begin', first), ('end', last)):
            date = datetime.fromtimestamp(time // 10**9, timezone.utc)
            table.add_row(name, f'{date:%Y-%m-%d %H:%M:%S}.{time // 10**6 % 1000:03} UTC')
        table.add_row('duration', f'{(last - first) / 1e9:.3f} s')
    return table


def _left_out(source: Mapping[str, Any]) -> str:
    if not source['phases_dropped']:
        return ''
    return (
        f'; left out of {source["phases_dropped"]} phases, {source["steps_dropped"]} of its steps '
        'were dropped'
    )


def _run(run: Mapping[str, Any]) -> Table:
    table = _pairs()
    table.add_row('run', f'{run["run_id"]} in {run["namespace"]}')
    for name, value in run['settings'].items():
        table.add_row('steps planned' if name == 'steps' else name, str(value))
    for name, source in run['sources'].items():
        table.add_row(
            f'source {name}',
            f'{source["task"] or "no task announced"}: {source["observation_size"]} observations, '
            f'{source["action_size"]} actions, {source["steps"]} steps in {source["chunks"]} '
            f'chunks, {source["episodes"]} episodes ({source["terminated"]} terminated, '
            f'{source["truncated"]} truncated)' + _left_out(source),
        )
    scored = f'{run["segments_scored"]}, {run["steps_scored"]} steps'
    unscored = run['segments_unscored']
    table.add_row('segments scored', scored + (f'; {unscored} without a score' * bool(unscored)))
    table.add_row('scores', _span(run['scores']))
    table.add_row('phases committed', _whole_span(run['phases']))
    table.add_row('policy versions', _whole_span(run['policy_versions']))
    table.add_row('reward model versions', _whole_span(run['model_versions']))
    table.add_row('labels', str(run['labels']))
    if run['evaluations']:
        step, last = list(run['evaluations'].items())[-1]
        text = f'{len(run["evaluations"])}, true return at step {step}: {_span(last)}'
        table.add_row('evaluations', text)
    return table


def _span(values: Mapping[str, float]) -> str:
    count = values.get('not_finite', 0)
    wrong = f'{count} not finite' if count else ''
    if not values['count']:
        return wrong or 'none'
    low, high, mean = (exact(values[name]) for name in ('min', 'max', 'mean'))
    text = f'{low} to {high}, mean {mean}'
    return f'{text}; {wrong}' if wrong else text


def _whole_span(values: Mapping[str, float]) -> str:
    if not values['count']:
        return 'none'
    return f'{values["count"]}, from {values["min"]} to {values["max"]}'


def _topics(topics: Mapping[str, Any]) -> Table:
    table = Table(box=None, pad_edge=False)
    table.add_column('topic', overflow='fold')
    table.add_column('type')
    table.add_column('messages', justify='right')
    table.add_column('MB', justify='right')
    for name, topic in topics.items():
        kind = topic['type'].removeprefix('codetr_msgs/msg/')
        table.add_row(name, kind, str(topic['messages']), f'{topic["bytes"] / 1e6:.2f}')
    return table
