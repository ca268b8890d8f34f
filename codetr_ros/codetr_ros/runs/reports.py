"""What each node of a run reports when it ends: `nodes/<role>-<name>.json`.

Only what is known is written: a simulator has no gradient steps, and on the way to a part of a run
in one process nothing can be lost.
"""

import json
import resource
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

from pydantic import Field, JsonValue

from codetr_ros.runs import facts
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs.facts import Counts, Facts
from codetr_ros.system.files import atomic_write


class MemoryFacts(Facts):
    """What the memory D holds, and what it takes."""

    steps: int = Field(description='steps that it holds at the end')
    evicted: int = Field(description='steps that have left it since the start')
    bytes_per_step: int = Field(description='bytes that a step takes')
    bytes: int = Field(description='bytes that all of it takes')


class StartedFrom(Facts):
    """The reward model that a run began with."""

    checkpoint: str = Field(description='folder of the checkpoint')
    reward_model_sha256: str = Field(description='digest of the weights in it')
    frozen: bool = Field(description='whether the model was left as it was')


class FlushTimes(Facts):
    """How long it took to get a phase of the bag onto the disk."""

    median: float = Field(description='median over the phases [ms]')
    max: float = Field(description='the longest [ms]')


class _Wired(Facts):
    """What whoever wires a core knows of it."""

    role: str = Field(description='one of sim, evaluate, reward, learner, record')
    name: str = Field(description='name of the node')
    published: Counts = Field({}, description='records that it published, by topic')
    received: Counts = Field({}, description='records that reached it, by topic')
    refused: Counts = Field({}, description='records that it refused, by topic')
    lost: Counts = Field({}, description='records that were published and never came, by topic')
    fetched: Counts = Field(
        {}, description='records that came only when they were asked for again, by topic'
    )
    peak_rss_mb: float | None = Field(
        None, description='most memory that its process had at once [MB]'
    )
    cpu_s: float | None = Field(
        None, description='processor time; in process the time of its slices [s]'
    )
    wall_s: float | None = Field(
        None, description='time from start to end; in process the time of its slices [s]'
    )
    finished: bool | None = Field(
        None, description='whether all that the run asked of it was done; null if not known'
    )
    error: str | None = Field(None, description='why it gave up; null if it did not')


class CoreReport(Facts):
    """What a core reports, whoever wires it."""

    refused: Counts = Field({}, description='records that it refused, by topic')
    lost: Counts = Field({}, description='records that were published and never came, by topic')
    duplicated: Counts = Field({}, description='records that came more than once, by topic')
    counters: Counts = Field({}, description='what else was counted, in words')
    memory: MemoryFacts | None = Field(None, description='what its memory D holds')
    updates: int | None = Field(None, description='SAC updates taken')
    policy_sha256: str | None = Field(None, description="digest of the policy's weights")
    gradient_steps: int | None = Field(None, description='gradient steps of the reward model')
    reward_model_sha256: str | None = Field(
        None, description="digest of the reward model's weights"
    )
    started_from: StartedFrom | None = Field(
        None, description='the reward model that it started from, if not from scratch'
    )


class BagReport(Facts):
    """What the recorder reports besides: what it has written, and how long the disk took."""

    recorded: Counts = Field({}, description='records that it wrote into the bag, by topic')
    bag: str | None = Field(None, description='folder of the bag that it wrote')
    bag_bytes: int | None = Field(None, description='size of the bag [bytes]')
    flush_seconds: float | None = Field(
        None, description='time that it took to get phases onto the disk, all together [s]'
    )
    flush_ms: FlushTimes | None = Field(
        None, description='time that it took to get a phase onto the disk'
    )


class NodeReport(BagReport, CoreReport, _Wired):
    """What a node, or a part of a run in one process, reports when it ends."""

    exit_code: int | None = Field(
        None,
        description='exit code of its process: known to whoever started it, not in the file',
    )


def node_report(
    core: CoreReport,
    *,
    role: str,
    name: str,
    published: Mapping[str, int],
    received: Mapping[str, int],
    refused: Mapping[str, int],
    lost: Mapping[str, int] | None = None,
    fetched: Mapping[str, int] | None = None,
    cpu_s: float,
    wall_s: float,
    finished: bool,
    error: str | None,
    own: BagReport | None = None,
) -> NodeReport:
    """The report of a node, whoever wires its core.

    Args:
        core: what its core reports.
        role: one of `records.ROLES`.
        name: name of the node.
        published: records that it published, by topic.
        received: records that reached it, by topic.
        refused: records that never came as far as the core, which adds those that it refused.
        lost: records that never came, by topic; None without topics.
        fetched: records that came when they were asked for again; None without topics.
        cpu_s: processor time [s].
        wall_s: time from start to end [s].
        finished: whether all that the run asked of it was done.
        error: why it gave up.
        own: what the node itself adds.
    """
    given: dict[str, JsonValue] = {
        'role': role,
        'name': name,
        'published': dict(published),
        'received': dict(received),
        'refused': dict(Counter(refused) + Counter(core.refused)),
        'peak_rss_mb': resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        'cpu_s': cpu_s,
        'wall_s': wall_s,
        'finished': finished,
        'error': error,
    }
    if lost is not None:
        given['lost'] = dict(Counter(lost) + Counter(core.lost))
    if fetched is not None:
        given['fetched'] = dict(fetched)
    return NodeReport.model_validate({**_known(core), **(_known(own) if own else {}), **given})


def _known(facts: Facts) -> dict[str, JsonValue]:
    """What is known, as it is written."""
    return facts.model_dump(mode='json', exclude_unset=True)


def write(path: Path, report: NodeReport) -> None:
    """Write a node's report; `folder.report_path` names the place."""
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic_write(path, json.dumps(_known(report), indent=2) + '\n')


def read(path: Path) -> NodeReport:
    """One node's report.

    Raises:
        RunFolderError: it is damaged, or not a node's report.
    """
    return facts.read(
        NodeReport, path, 'node report', 'remove the file, a summary can do without it'
    )


def read_all(folder: Path) -> dict[str, NodeReport]:
    """All node reports that are there, by `<role>-<name>`.

    Raises:
        RunFolderError: one of them is damaged.
    """
    paths = sorted((folder / run_folder.NODES).glob('*.json'))
    return {path.stem: read(path) for path in paths}
