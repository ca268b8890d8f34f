"""`codetr demo person`: a simulated person teaches an arm over topics, and whoever sits at this
machine watches, and may score too.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from codetr_ros import config
from codetr_ros.cli import beside, demo_run, refuse, train, train_over_topics
from codetr_ros.cli.terminal import console, parse_arguments
from codetr_ros.config import SettingsError
from codetr_ros.processes.launcher import LaunchError
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs import reports, run_summary
from codetr_ros.runs.folder import RunFolderError

NAME = 'you'
"""The scorer on the page; the simulated one has another name."""
SETTINGS: dict[str, Any] = {
    'scorer': 'simulated',
    'method': 'evidence',
    'evidence.link': 'known',
    'steps': 12_000,
    'evaluate_every': 2000,
    'requests': 8,
    'people.best': -3.0,
    'people.late': 0,
}
"""What differs from the preset `quick`.

The person answers while the learner is at work. With answers that come while the arm moves, it
would be for the machine to decide which phase learns from them, and with few scores that is most
of how the first phases end.
"""


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Let a simulated person teach an arm to reach a target.

    Starts all nodes of a run over topics, and a node in the place of a person, who is asked for
    some segments in each phase, gives each one to five points, not always rightly, and leaves
    some out. One page shows the run, and on another you may score beside it. It ends by
    itself after some minutes with a report. docs/people.md explains each part.
    """

    seed: Annotated[int, tyro.conf.arg(help='of the person, the simulator and the run')] = 0
    steps: Annotated[int | None, tyro.conf.arg(help='of the arm; else those of the demo')] = None
    out: Annotated[
        str | None, tyro.conf.arg(metavar='NEW', help='folder of the run; else in runs/')
    ] = None
    open: Annotated[
        bool, tyro.conf.arg(help='open both pages in the browser, if there is one here')
    ] = True


def main(arguments: Sequence[str]) -> int:
    """Run the example; returns the exit code."""
    given = parse_arguments(Arguments, prog='codetr demo person', arguments=arguments)
    try:
        steps = {} if given.steps is None else {'steps': given.steps}
        settings = config.load('quick').changed(SETTINGS | {'seed': given.seed} | steps)
        settings, run_id, folder = demo_run.begin('person', settings, given.out)
    except (SettingsError, RunFolderError, LaunchError) as error:
        return refuse(str(error))
    offered = beside.Offered(watch=True, score=NAME, open=given.open)
    shown = train.Shown(film=True, offered=offered)
    code = train.train(
        settings, run_id, folder, train_over_topics.Topics(), 'codetr demo person', shown
    )
    if code == 0:
        for line in told(folder):
            console().print(line, markup=False)
    return code


def told(folder: Path) -> list[str]:
    """What became of the judgements of a run, and where to look again, for people."""
    lines = []
    for report in reports.read_all(folder).values():
        if report.role == 'score' and report.counters:
            counts = ', '.join(f'{count} {what}' for what, count in report.counters.items())
            lines.append(f'{report.name}: {counts}')
    summary = run_summary.read(folder / run_folder.SUMMARY)
    for name, row in summary.scorers.items():
        lines.append(f'{name}: {row.scores} scores were learnt from')
    lines.append(f'report: {folder / run_folder.REPORT}; the page again: codetr watch {folder}')
    lines.append('score a run yourself: codetr train --scorer person --method evidence')
    return lines
