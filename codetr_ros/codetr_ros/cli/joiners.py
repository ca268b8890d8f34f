"""What people are told of the simulators that may join a run."""

import os
import shlex
from collections.abc import Mapping

from codetr_ros.config import Settings
from codetr_ros.nodes.signing import VARIABLE
from codetr_ros.records.roles import command


def how_to_join(
    settings: Settings, namespace: str, environ: Mapping[str, str] = os.environ
) -> list[str]:
    """How simulators join a run over topics, a line each; nothing if none may.

    Args:
        settings: of the run.
        namespace: that of its nodes.
        environ: the environment in which the run is started.
    """
    if not settings.joiners:
        return []
    where = ['--ros-args', '-r', f'__ns:={namespace}', '-r']
    starts = [f'{command("sim")} {shlex.join([*where, f"__node:={n}"])}' for n in settings.joiners]
    if environ.get(VARIABLE):
        return [f'{VARIABLE} is set: with it, a simulator joins by', *starts]
    return [
        f'warning: nobody can join: the key of the run is known to its own nodes only. Stop, '
        f'`export {VARIABLE}=$(openssl rand -hex 32)`, and start the run again. With that '
        'variable, a simulator then joins by',
        *starts,
    ]
