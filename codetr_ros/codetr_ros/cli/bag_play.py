"""`codetr bag play`: a recorded run, published again for nodes that learn from it."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import tyro

from codetr_ros.cli import refuse
from codetr_ros.cli.terminal import parse_arguments
from codetr_ros.processes import middleware

DEFAULT_NAMESPACE = '/play'


def _option(text: str, metavar: str | None = None) -> object:
    return tyro.conf.arg(help=text, metavar=metavar)


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Publish a recorded run again, for a reward node or a learner to train from, or to look at.

    You start the nodes that it is played to, in the namespace:

        ros2 run reward_node reward --ros-args -r __ns:=/play -p folder:=/tmp/played

    All other roles of the run are played. Playing ends when the nodes have learnt from everything.
    """

    bag: Annotated[
        str,
        tyro.conf.Positional,
        tyro.conf.arg(metavar='BAG', help="the bag's folder or file, or the folder of a run"),
    ]
    to: Annotated[
        tuple[Literal['reward', 'learner', 'evaluate', 'nobody'], ...],
        _option('nodes that you run; nobody: play without waiting for any node'),
    ] = ('reward',)
    pace: Annotated[
        Literal['commits', 'recorded'],
        _option('a phase as soon as the one before has been learnt from, or as it was recorded'),
    ] = 'commits'
    rate: Annotated[
        float | None, _option('speed, in multiples of real time; implies --pace recorded', 'R')
    ] = None
    namespace: Annotated[str, _option('the namespace to publish in')] = DEFAULT_NAMESPACE
    run: Annotated[str | None, _option('run to play, where the bag holds several', 'ID')] = None
    deadline: Annotated[
        float, _option('seconds to wait for nodes that are missing or silent; 0: for ever', 'S')
    ] = 60.0


def main(arguments: Sequence[str]) -> int:
    """Play a bag; returns the exit code."""
    given = parse_arguments(
        Arguments,
        prog='codetr bag play',
        arguments=arguments,
        config=(tyro.conf.FlagCreatePairsOff,),
    )
    live = tuple(role for role in given.to if role != 'nobody')
    recorded_pace = given.pace == 'recorded' or given.rate is not None
    if given.rate is not None and not given.rate > 0:
        return refuse(f'--rate {given.rate:g} must be greater than 0')
    if wrong := (
        middleware.wrong_seconds('--deadline', given.deadline)
        or middleware.wrong_namespace(given.namespace)
    ):
        return refuse(wrong)
    if live != given.to and live:
        return refuse(f'--to {" ".join(given.to)}: either nobody, or nodes')
    if 'evaluate' in live and 'learner' not in live:
        return refuse('--to evaluate: an evaluator follows a learner: play to the learner too')
    if not live and not recorded_pace:
        return refuse('--to nobody needs --pace recorded or --rate: no node sets the pace')

    from codetr_ros.bags.errors import BagError
    from codetr_ros.bags.playback import Pace, PlayError, items, recorded_run
    from codetr_ros.offline.sources import open_bags

    try:
        (bag,) = open_bags([Path(given.bag)])
        recorded = recorded_run(bag, given.run)
    except (BagError, PlayError) as error:
        return refuse(str(error))
    try:
        from codetr_ros.ros import player
    except ImportError as error:
        return refuse(
            f'playing needs ROS, which cannot be imported ({error}): `codetr doctor` names what '
            'is missing; `codetr fit` learns from bags without it'
        )
    middleware.set_defaults()
    code: int = player.play(
        recorded,
        lambda: items(bag, recorded.run.run_id),
        live,
        Pace(given.rate or 1.0) if recorded_pace else None,
        given.namespace,
        given.deadline,
    )
    return code
