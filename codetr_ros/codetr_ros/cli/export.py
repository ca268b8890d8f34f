"""`codetr export`: write the policy of a run into a file, to act on its robot without the run."""

import dataclasses
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from codetr_ros.cli import refuse
from codetr_ros.cli.evaluate import newest_policy, settings_here
from codetr_ros.cli.terminal import console, parse_arguments
from codetr_ros.config import SettingsError
from codetr_ros.nodes.errors import explains_itself
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs.folder import RunFolderError
from codetr_ros.system.files import FileError, check_makeable, make_folder

if TYPE_CHECKING:
    from codetr_ros.robots.policy_file import PolicyFile
    from codetr_ros.robots.robot_facts import RobotFacts


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Write the policy of a run's newest checkpoint into a file of its own, and test it.

    `ros2 run learner_node act -p checkpoint:=FILE` drives the robot by it, without the run, a
    learner or torch. The file has the weights, the topics, the limits and the rate of the robot
    that it was trained on: docs/your-robot.md. No ROS is needed.
    """

    run_dir: Annotated[
        str, tyro.conf.Positional, tyro.conf.arg(metavar='RUN_DIR', help="the run's folder")
    ]
    out: Annotated[
        str | None,
        tyro.conf.arg(
            metavar='FILE',
            help=f"the policy file; else {run_folder.POLICY} in the run's folder. One that exists "
            'is replaced',
        ),
    ] = None
    mapping: Annotated[
        str | None,
        tyro.conf.arg(
            metavar='FILE',
            help='the mapping of the robot, where its node did not write into the folder',
        ),
    ] = None
    robot: Annotated[
        str | None, tyro.conf.arg(metavar='NAME', help='which robot, of a run on several')
    ] = None


def main(arguments: Sequence[str]) -> int:
    """Export and print what is in the file; returns the exit code."""
    given = parse_arguments(Arguments, prog='codetr export', arguments=arguments)
    folder = Path(given.run_dir)
    path = Path(given.out) if given.out else folder / run_folder.POLICY
    if path.is_dir():
        return refuse(f'--out {given.out} is a folder: name a file, such as {path}/policy')
    try:
        settings_here(folder)  # before torch is imported
        check_makeable(path.parent)
    except (RunFolderError, SettingsError, FileError) as error:
        return refuse(str(error))
    try:
        made = make(folder, path, given.mapping, given.robot)
    except ValueError as error:
        if not explains_itself(error):
            raise
        return refuse(str(error))
    _show(made, path)
    return 0


def after_a_run(folder: Path) -> str:
    """Export the policy of a run on a robot that has just ended; what came of it, in words."""
    path = folder / run_folder.POLICY
    try:
        make(folder, path)
    except ValueError as error:
        if not explains_itself(error):
            raise
        return f'the policy was not exported: {error}'
    return f'the policy, to act by without the run: {_command(path)}'


def make(
    folder: Path, path: Path, mapping: str | None = None, robot: str | None = None
) -> 'PolicyFile':
    """Write the policy of a run's newest checkpoint into a file, and test the file.

    Args:
        folder: of the run.
        path: the file.
        mapping: the mapping of the robot; None: the one in the folder.
        robot: which robot, of several.

    Raises:
        ValueError: one that explains itself: the run, its checkpoint or the robot cannot be used.
        OSError: the file cannot be written.
    """
    from codetr_ros.robots.policy_export import export

    settings = settings_here(folder)
    known = _robot(folder, mapping, robot)
    policy = newest_policy(folder, settings)
    make_folder(path.parent)
    return export(policy, known, run_folder.read_settings(folder), path)


def _robot(folder: Path, given: str | None, name: str | None) -> 'RobotFacts':
    """The robot of a run, from its folder or the mapping that was given.

    Raises:
        RunFolderError: the run names none, or several.
        SettingsError: the mapping is not sound.
        AnotherRobotError: the mapping is that of another robot.
    """
    from codetr_ros.robots import mapping, robot_facts
    from codetr_ros.robots.same_robot import check_mapping

    if given is None:
        return robot_facts.read(folder, name)
    rules = mapping.load(Path(given))
    if not (folder / run_folder.ROBOTS).is_dir():
        return robot_facts.RobotFacts(mapping=rules, types={}, sizes=())
    there = robot_facts.read(folder, name)
    check_mapping(there.mapping, rules, given, f'the policy in {folder}', False)
    return there.model_copy(update={'mapping': rules})


def _show(made: 'PolicyFile', path: Path) -> None:
    """Print what is in the file."""
    said, network, rules = made.described, made.network, made.described.robot.mapping
    live, action = rules.live, rules.action
    assert live is not None
    types = said.robot.types or {}
    seen = '; '.join(
        f'{", ".join(each.fields)} of {each.topic}'
        + (f' ({types[each.topic]})' if each.topic in types else '')
        + (f', joints {", ".join(each.joints)}' if each.joints else '')
        + (f', in {", ".join(each.units)}' if each.units else '')
        for each in rules.observation
    )
    rows = {
        'policy': f'after phase {said.phase}, {said.steps} steps of run {said.run_id}',
        'observation': f'{network.observation_size} numbers: {seen}',
        'action': f'{network.action_size} numbers, {said.action}, -1 to 1 as {action.low} to '
        f'{action.high} on {action.topic} ({live.command.type}), {live.rate:g} times a second',
        'limits': ', '.join(
            f'{name} {value}'
            for name, value in live.limits.model_dump(exclude_none=True).items()
            if not isinstance(value, dict)
        )
        or 'none but the scaling',
        'test': f'{len(made.examples["steps"])} examples, within {said.tolerance:g}',
        'output': str(path),
    }
    if live.limits.position is not None:
        position = live.limits.position
        rows['limits'] += f'; positions {position.low} to {position.high}'
    shown = console()
    for name, text in rows.items():
        shown.print(f'{name:<12}{text}')
    shown.print(f'\n{_command(path)}')


def _command(path: Path) -> str:
    """What acts by a policy file. An installation from wheels has no `ros2`."""
    program = 'ros2 run learner_node act'
    if shutil.which('ros2') is None:
        program = f'{sys.executable} -m learner_node.act'
    return f'{program} --ros-args -p checkpoint:={path}'
