"""`codetr demo robot`: a robot that knows nothing of this project learns in real time, from scores
that an inspection gives late and not always.
"""

import dataclasses
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import tyro

from codetr_ros import config
from codetr_ros.cli import FAILED, demo_run, export, refuse
from codetr_ros.cli.terminal import console, parse_arguments
from codetr_ros.config import Settings, SettingsError
from codetr_ros.processes import launcher
from codetr_ros.processes.launcher import Command, LaunchError
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs.folder import RunFolderError
from codetr_ros.system.files import atomic_write

EXAMPLE = Path('examples') / 'robot_arm'
SCORES = 'scores.csv'
TRUTH = 'arm_truth.jsonl'


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Let a robot in real time learn from scores.

    Starts a stand-in robot (an arm with topics of its own, noise, latency and faults), an
    inspection that scores it, and the nodes of a run; ends by itself after some minutes with a
    report. docs/your-robot.md explains each part.
    """

    seed: Annotated[int, tyro.conf.arg(help='of the robot, its faults and the run')] = 0
    steps: Annotated[
        int | None, tyro.conf.arg(help='control steps, twenty a second; else those of the example')
    ] = None
    out: Annotated[
        str | None, tyro.conf.arg(metavar='NEW', help='folder of the run; else in runs/')
    ] = None
    example: Annotated[
        str | None, tyro.conf.arg(metavar='FOLDER', help="the example's folder, if not found")
    ] = None


def main(arguments: Sequence[str]) -> int:
    """Run the example; returns the exit code."""
    given = parse_arguments(Arguments, prog='codetr demo robot', arguments=arguments)
    example = Path(given.example) if given.example else _example()
    if example is None or not (example / 'stand_in.py').is_file():
        return refuse(
            f'the stand-in robot is not in {example or EXAMPLE}: start from the folder of the '
            'repository, or give --example FOLDER'
        )
    try:
        changes: dict[str, int] = {'seed': given.seed}
        if given.steps is not None:
            changes['steps'] = given.steps
        settings = config.load(str(example / 'settings.yaml')).changed(changes)
        settings, run_id, folder = demo_run.begin('robot', settings, given.out)
    except (SettingsError, RunFolderError, LaunchError) as error:
        return refuse(str(error))
    return _run(settings, run_id, folder, example)


def _example() -> Path | None:
    """The folder of the example: below this one, or beside the sources of this package."""
    above = Path(__file__).resolve().parents[3]
    return next((p / EXAMPLE for p in (Path.cwd(), above) if (p / EXAMPLE).is_dir()), None)


def _run(settings: Settings, run_id: str, folder: Path, example: Path) -> int:
    from codetr_ros.cli import train, train_over_topics

    shown = console()
    others = _robot_and_inspection(settings, launcher.namespace_of(run_id), folder, example)
    topics = train_over_topics.Topics(
        robot={'mapping': str(example / 'live.yaml'), 'autostart': True},
    )
    with launcher.Processes(lambda text: shown.print(text, markup=False)) as processes:
        try:
            processes.start(others, folder / run_folder.LOGS, beside(settings, topics.key))
        except LaunchError as error:
            return refuse(str(error))
        code = train.train(settings, run_id, folder, topics, f'codetr demo robot ({example})')
        if failed := [node.how_it_ended() for node in processes.nodes if node.code is not None]:
            shown.print(f'codetr: {"; ".join(failed)} before the run was over', markup=False)
            code = code or FAILED
    return code or _show(settings, folder)


def beside(settings: Settings, key: Mapping[str, str]) -> dict[str, str]:
    """The environment of robot and inspection: with the key of the run, to sign scores with."""
    return launcher.environment(settings, os.environ) | dict(key)


def _robot_and_inspection(
    settings: Settings, namespace: str, folder: Path, example: Path
) -> list[Command]:
    """The processes that are none of this project's."""
    seed = ('--seed', str(settings.seed))
    python = sys.executable
    log = str(folder / run_folder.LOGS / TRUTH)
    arm = (python, str(example / 'stand_in.py'), *seed, '--log', log)
    ros = ('--ros-args', '-r', f'__ns:={namespace}')
    inspection = (python, str(example / 'inspection.py'), *seed, *ros)
    return [Command('arm', 'robot', arm), Command('inspection', 'scorer', inspection)]


def _show(settings: Settings, folder: Path) -> int:
    """Print how the scores went, and write them by phase and as a page."""
    from codetr_ros.bags.reader import Bag
    from codetr_ros.offline.robot_report import PAGE, faults, robot_page
    from codetr_ros.offline.score_course import score_course
    from codetr_ros.runs import reports

    course = score_course(Bag(folder / run_folder.BAG))
    atomic_write(folder / SCORES, course.to_csv())
    last = max(1, settings.phases // 5)
    warmup = settings.warmup_phases
    outcome = {}
    for name, first, end in (
        ('score per step, random policy', 0, warmup),
        ('score per step, the last fifth', settings.phases - last, settings.phases),
    ):
        mean, error, count = course.mean(first, end)
        outcome[name] = f'{mean:.3f} ± {error:.3f} ({count} scores)'
    robot = next((r for r in reports.read_all(folder).values() if r.role == 'sim'), None)
    noted = faults(folder / run_folder.LOGS / TRUTH)
    title = f'A robot in real time, {settings.steps} control steps, seed {settings.seed}'
    atomic_write(folder / PAGE, robot_page(title, course, outcome, warmup, robot, noted))
    shown = console()
    for name, value in outcome.items():
        shown.print(f'{name}: {value}', markup=False)
    shown.print(f'{folder / PAGE}, by phase: {folder / SCORES}', markup=False)
    shown.print(export.after_a_run(folder), markup=False)
    return 0
