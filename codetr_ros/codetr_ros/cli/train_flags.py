"""The flags of `codetr train` that are no settings of the run."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from codetr_ros.cli import film
from codetr_ros.nodes.silence import LEAVE_OUT_AFTER
from codetr_ros.processes import middleware, restarts

PEER_DEADLINE = 60.0
"""Seconds that nodes wait for each other unless the user gives others."""

FLAGS: Sequence[tuple[str, Any, Any]] = [
    (
        'out',
        Annotated[
            str | None,
            tyro.conf.arg(
                metavar='DIR',
                help='output folder, new or empty; by default runs/<task>-<method>-<seed>-<time>',
            ),
        ],
        None,
    ),
    (
        'namespace',
        Annotated[
            str | None,
            tyro.conf.arg(metavar='/NAME', help='namespace of the nodes; by default /run_<id>'),
        ],
        None,
    ),
    (
        'peer_deadline',
        Annotated[
            float,
            tyro.conf.arg(
                metavar='S',
                help='seconds that nodes wait for one that is missing or silent; 0: for ever',
            ),
        ],
        PEER_DEADLINE,
    ),
    (
        'leave_out_after',
        Annotated[
            float,
            tyro.conf.arg(
                metavar='S',
                help='seconds of silence after which a simulator of several is left out, and the '
                'run goes on without it until it is there again; 0: never',
            ),
        ],
        LEAVE_OUT_AFTER,
    ),
    (
        'restarts',
        Annotated[
            int,
            tyro.conf.arg(
                metavar='N',
                help='how often a node that was killed is started again; 0: the run ends with it',
            ),
        ],
        restarts.MOST,
    ),
    (
        'restarts_within',
        Annotated[
            float,
            tyro.conf.arg(metavar='S', help='seconds in which it is started again so often'),
        ],
        restarts.WITHIN,
    ),
    (
        'in_process',
        Annotated[
            bool,
            tyro.conf.arg(help='do the same run with plain calls, without nodes and topics'),
        ],
        False,
    ),
    (
        'watch',
        Annotated[
            bool,
            tyro.conf.arg(help='serve a page that shows the run, to browsers of this machine'),
        ],
        False,
    ),
    (
        'open',
        Annotated[bool, tyro.conf.arg(help='open the pages that are served in the browser here')],
        False,
    ),
    (
        'score_service',
        Annotated[
            bool,
            tyro.conf.arg(
                help='serve score_segment and wanted_segments, ROS services for programs that '
                'score, to all who know the token that is printed'
            ),
        ],
        False,
    ),
    (
        'camera',
        Annotated[
            str,
            tyro.conf.arg(
                metavar='TOPIC',
                help='show what a camera publishes there (sensor_msgs Image or CompressedImage) '
                'on the page to score',
            ),
        ],
        '',
    ),
    (
        'bag',
        Annotated[
            bool,
            tyro.conf.arg(
                help='record a run in process; nodes always do. Without its bag a run cannot be '
                'gone on with'
            ),
        ],
        True,
    ),
    (
        'resume',
        Annotated[
            Path | None,
            tyro.conf.arg(
                metavar='DIR',
                help='go on with the run in this folder where it ended or was killed, with its '
                'settings; with more --steps a finished one too',
            ),
        ],
        None,
    ),
    (
        'tensorboard',
        Annotated[
            bool, tyro.conf.arg(help='write events for TensorBoard into the folder tensorboard')
        ],
        False,
    ),
    ('film', Annotated[bool, tyro.conf.arg(help=film.HELP)], True),
]
"""Name, annotated type and default of each."""


def wrong(extra: Mapping[str, Any]) -> str | None:
    """Why flags that are no settings cannot be used; None if they can."""
    namespace = extra['namespace']
    if not extra['bag'] and not extra['in_process']:
        return '--no-bag is for --in-process: nodes go on after a fault only with a bag'
    if namespace is not None and extra['in_process']:
        return '--namespace is for nodes, and --in-process starts none: leave out one of them'
    if namespace is not None and (reason := middleware.wrong_namespace(namespace)):
        return reason
    return (
        middleware.wrong_seconds('--peer-deadline', extra['peer_deadline'])
        or middleware.wrong_seconds('--leave-out-after', extra['leave_out_after'], 'never')
        or restarts.wrong(extra['restarts'], extra['restarts_within'])
    )
