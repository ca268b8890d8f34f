"""How a node joins a run: it learns of the run, takes its settings and makes the core."""

import os
import secrets
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from codetr_ros.config import IN_PROCESS_ONLY, Settings, from_canonical, settled
from codetr_ros.cores.core import Core
from codetr_ros.nodes import leaving
from codetr_ros.nodes.errors import NodeError
from codetr_ros.nodes.signing import VARIABLE, is_keyed
from codetr_ros.processes.openmp import threading_environment
from codetr_ros.records import RunSpec
from codetr_ros.records.roles import command
from codetr_ros.ros import parameters
from codetr_ros.ros.gathering import IDLE, wait_for
from codetr_ros.ros.membership import Membership
from codetr_ros.ros.signals import Stopped
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs import origin
from codetr_ros.simulation import tasks
from codetr_ros.system.files import make_folder

NAME_PATIENCE = 2.0  # [s] until the name of a node with known topics is known

MakeCore = Callable[..., Core[Any]]
"""Makes the core of a node from (run, settings, name within the run, folder of checkpoints or
None) and, by name, the node's own parameters that `own_parameters.core_parameters` lists."""

LoadCore = Callable[[], MakeCore]
"""Does the slow imports (seconds) and returns what makes the core. Called once the run is known:
a learner announces its run first, and then all nodes import at the same time."""

Announce = Callable[[Membership], tuple[RunSpec, Settings]]
"""Decides what run it is, in the node that announces it."""


@dataclass(frozen=True)
class Joined:
    """What a node has after joining a run.

    Attributes:
        run: the run.
        settings: its settings.
        core: the node's part of the run.
        folder: the folder of the run; None if the node was given none.
    """

    run: RunSpec
    settings: Settings
    core: Core[Any]
    folder: Path | None


def refuse_in_process_only(who: str, settings: Settings) -> None:
    """Refuse a method that nodes cannot run.

    Raises:
        NodeError: the method runs in process only.
    """
    if settings.method in IN_PROCESS_ONLY:
        raise NodeError(
            f'{who}: method = {settings.method!r} {IN_PROCESS_ONLY[settings.method]}, so that it '
            f'runs in process only: use `codetr train --in-process --method {settings.method}`, '
            'or start the learner with another method'
        )


def refuse_idle_reward(who: str, role: str, settings: Settings) -> None:
    """Refuse a reward node in a run without step rewards.

    Raises:
        NodeError: the learner learns from the scores themselves.
    """
    if role == 'reward' and role not in settings.roles:
        raise NodeError(
            f'{who}: method = {settings.method!r} learns from the scores in the learner and needs '
            'no reward node: stop this one, or start the learner with another method'
        )


def refuse_used_folder(who: str, folder: Path, settings: Settings, run_id: str) -> None:
    """Refuse a folder that holds another run.

    Raises:
        NodeError: it holds other settings, or another run's checkpoints.
        SettingsError: its settings cannot be read.
    """
    remedy = 'give the parameter folder another one, or remove it'
    path = folder / run_folder.CONFIG
    if path.is_file() and settled(run_folder.read_settings(folder)) != settings:
        raise NodeError(
            f'{who}: folder {folder} holds another run, its {run_folder.CONFIG} has other '
            f'settings: {remedy}'
        )
    checkpoints = folder / run_folder.CHECKPOINTS
    if not checkpoints.is_dir() or not (names := sorted(p.name for p in checkpoints.iterdir())):
        return
    begun = (folder / run_folder.ORIGIN).is_file()
    there = origin.read(folder).run_id if begun else None
    if there is None or there != run_id:
        known = '' if there is None else f' (run_id = {there!r}, with which it would go on)'
        raise NodeError(
            f'{who}: folder {folder} holds another run{known}, whose checkpoints are in '
            f'{checkpoints} ({", ".join(names[:3])}): {remedy}'
        )


def own_run(member: Membership) -> tuple[RunSpec, Settings]:
    """The run that a learner announces, from its parameters.

    Raises:
        NodeError: nodes cannot run the method, or the folder holds another run.
        ParameterError: a setting is refused.
        TaskError: the task is unknown or cannot be used.
    """
    who = member.link.full_name
    settings = settled(parameters.own_settings(member.link.node, member.values['config']))
    refuse_in_process_only(who, settings)
    if not settings.on_robot:  # the robot announces its horizon itself
        tasks.check(settings, tasks.find(settings.task))
    if member.folder:
        refuse_used_folder(who, member.folder, settings, member.values['run_id'])
    made = f'{time.strftime("%Y%m%d-%H%M%S")}-{secrets.token_hex(2)}'
    return settings.run_spec(member.values['run_id'] or made), settings


def join(
    member: Membership,
    load_core: LoadCore,
    announce: Announce | None = None,
    looks_on: bool = False,
) -> Joined | None:
    """Join a run; None if asked to stop meanwhile.

    Args:
        member: the node that joins.
        load_core: imports and returns what makes the core.
        announce: decides what run it is, in the learner; all others wait for its announcement.
        looks_on: whether it may join a run that would take nothing of it (`Membership.outside`).

    Raises:
        NodeError: no run is announced, or one that this node cannot join.
        ParameterError: a parameter is wrong, or contradicts the run.
        SettingsError: the run's settings cannot be read.
    """
    member.introduce()
    node, link = member.link.node, member.link
    settings = None
    if announce is not None:
        member.run, settings = announce(member)
    member.publish_presence()
    run = _known(member)
    if run is None:
        return None
    if settings is None:
        settings = _taken(member, run)
        member.outside = _outside(member, run)
        if member.outside and not looks_on:
            raise NodeError(f'{link.full_name}: {member.outside}')
    parameters.declare_settings(node, settings)
    member.publish_presence()
    if announce is not None:
        link.advertise(['run'], settings)
        link.publish(run)
    os.environ.update(threading_environment(settings))  # read when torch is imported
    try:
        with member.stop.cutting_short():
            make_core = load_core()
    except Stopped:
        return None
    if 'torch' in sys.modules:  # the recorder has no torch and needs none
        sys.modules['torch'].set_num_threads(settings.thread_count)
    folder = member.folder
    if announce is not None and folder:
        make_folder(folder)
        begun = (folder / run_folder.CONFIG).exists()
        if not (begun and (folder / run_folder.ORIGIN).exists()):
            namespace = link.full_name.rpartition('/')[0] or '/'
            origin.write(folder, origin.origin(settings, run.run_id, namespace, False, True, None))
        if not begun:
            run_folder.write_settings(folder, settings)  # the last: from now on it can go on
    if folder:
        leaving.forget_report(folder, member.role, link.name)
    checkpoints = folder / run_folder.CHECKPOINTS if folder else None
    core = make_core(run, settings, link.name, checkpoints, **member.core_values)
    member.serve(core, settings)
    return Joined(run, settings, core, folder)


def _known(member: Membership) -> RunSpec | None:
    """The run, once it is known; None if asked to stop meanwhile."""
    run_id = member.values['run_id']
    wanted = f'run {run_id!r}' if run_id else 'a run'
    topic = member.link.node.resolve_topic_name('run')
    remedy = f'start `{command("learner")}` in this namespace'

    def lacking() -> list[str]:
        if member.run:
            return []
        if member.link.key is not None and member.traffic.refused['run']:
            return [
                f'an announcement of {wanted} on {topic!r} that is signed with the key of this '
                f'node: give it the {VARIABLE} of the run'
            ]
        return [f'the learner, which announces {wanted} on {topic!r} ({remedy})']

    return member.run if wait_for(member, lacking, member.peers.cause) else None


def _outside(member: Membership, run: RunSpec) -> str:
    """Why nothing that this node publishes would be taken; empty if it would."""
    if member.link.key is not None or not is_keyed(member.announcement):
        return ''
    return (
        f'run {run.run_id!r} has a key and this process has none, so that nothing it publishes '
        f'would be taken. Set {VARIABLE} before you start the run (export {VARIABLE}=$(openssl '
        'rand -hex 32)), and to the same value where you start this process. The page that '
        '`codetr train --scorer person` serves has the key of its run'
    )


def _taken(member: Membership, run: RunSpec) -> Settings:
    """The settings of a run that another node announced."""
    who, owner = member.link.full_name, _owner(member)
    settings = from_canonical(run.settings, f'run {run.run_id!r} of {owner}')
    refuse_in_process_only(who, settings)
    refuse_idle_reward(who, member.role, settings)
    parameters.check_against_run(member.link.node, settings, owner)
    return settings


def _owner(member: Membership) -> str:
    """The learner of the run, for errors. ROS discovers its topics before its name."""
    node = member.link.node
    end = time.monotonic() + NAME_PATIENCE
    while not member.stop:
        names = sorted(
            f'{info.node_namespace.rstrip("/")}/{info.node_name}'
            for info in node.get_publishers_info_by_topic(node.resolve_topic_name('run'))
            if info.node_name != '_NODE_NAME_UNKNOWN_'
        )
        if names or time.monotonic() > end:
            return f'learner {" or ".join(names) or "of the run"}'
        member.turn(IDLE)
    return 'learner of the run'
