"""`codetr label`: add the step rewards of a reward model to a bag."""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from codetr_ros.bags.errors import BagError
from codetr_ros.cli import FAILED, refuse
from codetr_ros.cli.terminal import console, parse_arguments
from codetr_ros.config import SettingsError
from codetr_ros.offline.errors import FitError
from codetr_ros.records import RecordError
from codetr_ros.system.files import FileError, check_makeable


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Write a bag with the step rewards of all scored segments added, for anybody's use.

    NEW holds every message of BAG byte for byte. StepRewards messages follow at its end, on the
    topic step_rewards beside that of the steps. No ROS is needed.
    """

    bag: Annotated[
        str, tyro.conf.Positional, tyro.conf.arg(metavar='BAG', help="a bag, or a run's folder")
    ]
    checkpoint: Annotated[
        str,
        tyro.conf.arg(
            metavar='PATH', help='the reward model: folder of a fit, of a run or of a checkpoint'
        ),
    ]
    out: Annotated[str, tyro.conf.arg(metavar='NEW', help='folder of the new bag, new or empty')]
    memory_steps: Annotated[
        int, tyro.conf.arg(metavar='N', help='the most steps to hold in memory at a time')
    ] = 1_000_000
    reward_device: Annotated[
        str,
        tyro.conf.arg(
            metavar='DEVICE',
            help='device for labelling, wherever the model has learnt: cpu, cuda, cuda:1, ...',
        ),
    ] = 'cpu'


def main(arguments: Sequence[str]) -> int:
    """Label and print what was labelled; returns the exit code."""
    given = parse_arguments(Arguments, prog='codetr label', arguments=arguments)
    try:
        check_makeable(Path(given.out))
    except FileError as error:
        return refuse(f'--out {given.out}: {error}')
    if given.memory_steps < 1:
        return refuse(f'--memory-steps {given.memory_steps}: at least 1 step must be held')
    from codetr_ros.offline import labelling, sources
    from codetr_ros.rewards import saved
    from codetr_ros.rewards.base import RewardModelError
    from codetr_ros.runs.checkpoints import CheckpointError
    from codetr_ros.system.devices import DeviceError

    try:
        (bag,) = sources.open_bags([Path(given.bag)])
        model = saved.read(Path(given.checkpoint))
        where = {'reward_device': given.reward_device}
        settings = model.settings.changed(where, 'command line')
        model = dataclasses.replace(model, settings=settings)
        made = labelling.label(bag, model, Path(given.out), given.memory_steps)
    except (BagError, CheckpointError, FitError, RecordError, SettingsError) as error:
        return refuse(str(error))
    except (RewardModelError, DeviceError) as error:
        print(f'codetr: {error}', file=sys.stderr)
        return FAILED
    shown = console()
    skipped = ', '.join(f'{n} {name}' for name, n in made.skipped.items() if n)
    rows = {
        'labelled': f'{made.segments} segments, {made.steps} steps, on '
        f'{", ".join(sorted(made.topics)) or "no topic"}',
        'not labelled': f'{made.unlabelled} steps that no score covers',
        'skipped': skipped or 'nothing',
        'copied': f'{made.messages} messages, byte for byte',
        'output': given.out,
    }
    for name, text in rows.items():
        shown.print(f'{name:<16}{text}')
    return 0
