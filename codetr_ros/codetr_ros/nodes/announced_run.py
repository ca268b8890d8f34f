"""Whether an announced run is the one that a node joins."""

import hashlib

from codetr_ros.config import SettingsError, from_canonical
from codetr_ros.records import PROTOCOL_VERSION, RecordError, RunSpec, describe


class SecondRunError(RecordError):
    """Two runs are announced in one namespace."""


def is_new(spec: RunSpec, own: RunSpec | None, wanted: str, who: str) -> bool:
    """Whether an announcement is that of a run to join; not if its learner was started again.

    Args:
        spec: the announcement.
        own: the run that the node is part of; None: of none yet.
        wanted: id of the only run that it may join; empty: any.
        who: the node's full name, for errors.

    Raises:
        SecondRunError: the node is part of another run.
        RecordError: it is no run that this program can join, or not the wanted one.
    """
    if own is not None and spec.run_id == own.run_id:
        if (spec.settings_hash, spec.seed) != (own.settings_hash, own.seed):
            raise RecordError(
                f'run {spec.run_id!r} is announced again with other settings: stop the second '
                'learner'
            )
        return False
    if spec.protocol_version != PROTOCOL_VERSION:
        raise RecordError(
            f'{describe(spec)}: run {spec.run_id!r} speaks protocol_version '
            f'{spec.protocol_version}, {who} speaks {PROTOCOL_VERSION}: install the same version '
            'of codetr_ros everywhere'
        )
    if hashlib.sha256(spec.settings.encode()).hexdigest() != spec.settings_hash:
        raise RecordError(
            f'run {spec.run_id!r}: settings_hash {spec.settings_hash!r} is not that of its '
            'settings: install the same version of codetr_ros everywhere'
        )
    if own is not None:
        raise SecondRunError(
            f'a second run in the namespace of {who}: {spec.run_id!r} beside {own.run_id!r}. Stop '
            'one of them, or give each run a namespace of its own (--ros-args -r __ns:=/other)'
        )
    if wanted not in ('', spec.run_id):
        raise RecordError(
            f'run {spec.run_id!r} is not the one that {who} was started for (parameter run_id = '
            f'{wanted!r}): leave run_id out, or start that learner'
        )
    try:
        from_canonical(spec.settings, f'run {spec.run_id!r}')
    except SettingsError as error:
        raise RecordError(str(error)) from None
    return True
