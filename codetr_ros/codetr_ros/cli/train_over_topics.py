"""`codetr train`: the run as nodes, which it starts, watches, starts again and ends."""

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from codetr_ros.cli import results
from codetr_ros.cli.audience import Audience
from codetr_ros.cli.outcome import Outcome
from codetr_ros.cli.train_flags import PEER_DEADLINE
from codetr_ros.config import Settings
from codetr_ros.nodes import signing
from codetr_ros.nodes.silence import LEAVE_OUT_AFTER
from codetr_ros.processes import launcher
from codetr_ros.processes.launcher import LaunchError
from codetr_ros.processes.restarts import Restarts, may_be_started_again
from codetr_ros.processes.supervise import (
    Interrupts,
    Silence,
    failed_at,
    is_over,
    supervise,
    why_it_gave_up,
)
from codetr_ros.records import Record
from codetr_ros.records.roles import TABLE
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs import reports as node_reports
from codetr_ros.runs.reports import NodeReport
from codetr_ros.runs.summary import Summary

if TYPE_CHECKING:
    from codetr_ros.ros.watch import Watcher


@dataclasses.dataclass(frozen=True)
class Topics:
    """How the nodes of a run are started.

    Attributes:
        namespace: that of the nodes; None: one of the run's own.
        peer_deadline: seconds that they wait for each other; 0: for ever.
        leave_out_after: seconds of silence after which a simulator of several is left out; 0:
            never.
        start: starts each.
        robot: parameters of the robot node, where the task is that of a robot.
        restarts: how often one that was killed is started again.
        key: the variable with the key of the run, for all that takes part in it.
    """

    namespace: str | None = None
    peer_deadline: float = PEER_DEADLINE
    leave_out_after: float = LEAVE_OUT_AFTER
    start: launcher.Start = launcher.start_program
    robot: Mapping[str, str | bool] | None = None
    restarts: Restarts = dataclasses.field(default_factory=Restarts)
    key: Mapping[str, str] = dataclasses.field(default_factory=signing.environment, repr=False)


def watcher(settings: Settings) -> 'type[Watcher]':
    """What watches the nodes of a run.

    Raises:
        LaunchError: ROS cannot be imported.
    """
    # it lives in this process and must look for the nodes where they are
    environment = launcher.environment(settings).items()
    os.environ.update({n: v for n, v in environment if n.startswith(('ROS_', 'RMW_'))})
    try:
        from codetr_ros.ros.watch import Watcher
    except ImportError as error:
        raise LaunchError(
            f'ROS cannot be imported ({error}): `codetr doctor` names what is missing; '
            '--in-process trains without ROS'
        ) from error
    return Watcher


def run(
    settings: Settings,
    run_id: str,
    folder: Path,
    audience: Audience,
    interrupts: Interrupts,
    topics: Topics,
) -> Outcome:
    """Do the run, or go on with it.

    Args:
        settings: its settings.
        run_id: its name.
        folder: its folder.
        audience: takes what its nodes publish.
        interrupts: counts the user's requests to stop.
        topics: how the nodes are started.
    """
    namespace = topics.namespace or launcher.namespace_of(run_id)
    commands = launcher.commands(
        settings,
        run_id,
        folder,
        namespace=namespace,
        peer_deadline=topics.peer_deadline,
        leave_out_after=topics.leave_out_after,
        robot=topics.robot,
    )
    watch = watcher(settings)
    environment = launcher.environment(settings) | dict(topics.key)
    silence, summary, progress = Silence(), audience.summary, audience.progress

    def receive(record: Record) -> None:
        silence.receive(record)
        audience.receive(record)

    failure = None
    asked = interrupts.again
    with launcher.Processes(progress.log, asked, start_program=topics.start) as processes:
        try:
            # The watcher comes first, so as to receive everything from the nodes' start on.
            with watch(receive, namespace, key=signing.key_of(environment)) as watching:

                def poll() -> None:
                    watching.poll(0.1)
                    audience.tick()

                processes.start(commands, folder / run_folder.LOGS, environment)
                failure = supervise(
                    processes,
                    poll,
                    interrupts,
                    silence,
                    lambda node: why_it_gave_up(node, folder),
                    restarts=topics.restarts,
                    over=lambda node: is_over(node, folder),
                    dispensable=lambda node: _can_do_without(node, summary, folder),
                    failed_at=lambda node: failed_at(node, folder),
                )
                watching.poll(0.0)  # the last messages of the last node
        except LaunchError as error:
            failure = str(error)
    reports = node_reports.read_all(folder)
    for node in processes.nodes:
        key = run_folder.report_path(folder, node.role, node.name).stem
        known = reports.get(key) or NodeReport(role=node.role, name=node.name)
        reports[key] = known.model_copy(
            update={'exit_code': node.code, 'restarts': topics.restarts.counts[node.name]}
        )
    summary.end()
    interrupted = bool(interrupts.count)
    if (folder / run_folder.BAG).exists():  # else no recorder started, and the failure names it
        progress.log('reading the bag for the summary')
        before = interrupts.count
        bag = folder / run_folder.BAG
        results.complete(summary, bag, progress.log, lambda: interrupts.count > before)
    culprit = next((node.log for node in processes.nodes if node.unasked_failure), None)
    return Outcome(reports, interrupted, failure, culprit)


def _can_do_without(node: launcher.Node, summary: Summary, folder: Path) -> bool:
    """Whether a run goes on without a node that has failed for good. Nobody begins before all are
    there: one that fails with a reason before the first commit has none to wait for. A simulator
    without which the recorder has finished is not needed any more.
    """
    if node.role == 'sim' and node.code is None:
        return node_reports.has_finished(folder, 'record')
    begun = summary.phases > 0 or may_be_started_again(node.code) or node.code is None
    return begun and TABLE[node.role].dispensable
