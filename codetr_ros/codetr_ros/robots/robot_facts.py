"""What a robot was while it learnt: its mapping, the types of its topics, the sizes of what it
observed. The robot node writes it into the folder of the run.
"""

import json
from pathlib import Path

from pydantic import Field

from codetr_ros.robots.mapping import Mapping
from codetr_ros.runs import facts
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs.facts import Facts
from codetr_ros.runs.folder import RunFolderError
from codetr_ros.system.files import atomic_write, make_folder


class RobotFacts(Facts):
    """What a robot is, for a policy that is to act on it."""

    mapping: Mapping = Field(description='topics, fields, joints, scaling, limits, rate')
    types: dict[str, str] = Field(description='types of the topics by name; empty: not known')
    sizes: tuple[int, ...] = Field(
        description='numbers of each entry of the observation; empty: not known'
    )


def write(folder: Path, name: str, made: RobotFacts) -> None:
    """Write what a robot is into the folder of a run.

    Args:
        folder: of the run.
        name: the source that the robot is in the run.
        made: what it is.
    """
    make_folder(folder / run_folder.ROBOTS)
    text = json.dumps(made.model_dump(mode='json'), indent=1)
    atomic_write(folder / run_folder.ROBOTS / f'{name}.json', f'{text}\n')


def read(folder: Path, name: str | None = None) -> RobotFacts:
    """What the robot of a run was.

    Args:
        folder: of the run.
        name: which of its robots; None: the only one.

    Raises:
        RunFolderError: the run has no such robot, or several and none is named, or the file is
            damaged.
    """
    place = folder / run_folder.ROBOTS
    there = sorted(path.stem for path in place.glob('*.json')) if place.is_dir() else []
    if not there:
        raise RunFolderError(
            f'{place} names no robot: its node had another folder, or this was no run on a robot. '
            'Give the mapping of the robot with --mapping FILE'
        )
    if name is None and len(there) > 1:
        raise RunFolderError(
            f'the run in {folder} has {len(there)} robots: give --robot and one of '
            f'{", ".join(there)}'
        )
    if name is not None and name not in there:
        raise RunFolderError(
            f'the run in {folder} has no robot {name!r}: give --robot and one of '
            f'{", ".join(there)}'
        )
    path = place / f'{name or there[0]}.json'
    return facts.read(RobotFacts, path, 'robot', 'give its mapping with --mapping FILE')
