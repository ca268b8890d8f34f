"""The report that each node of a run writes when it ends: `nodes/<role>-<name>.json`.

Only known facts are written: a simulator has no gradient steps, and in a run in one process no
record can be lost.
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
from codetr_ros.system.files import atomic_write, make_folder

PREFERENCES_UNUSED = 'preferences not used, method cannot'
"""A count of judgements that are not learnt from."""


class MemoryFacts(Facts):
    """The contents of the memory D, and its size."""

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
    """How long it took to flush a phase of the bag to the disk."""

    median: float = Field(description='median over the phases [ms]')
    max: float = Field(description='the longest [ms]')


class _Wired(Facts):
    """The facts that the wiring of a core knows."""

    role: str = Field(description='one of sim, evaluate, reward, learner, record')
    name: str = Field(description='name of the node')
    published: Counts = Field({}, description='records that it published, by topic')
    received: Counts = Field({}, description='records that reached it, by topic')
    refused: Counts = Field({}, description='records that it refused, by topic')
    lost: Counts = Field({}, description='records that were published and never arrived, by topic')
    fetched: Counts = Field(
        {}, description='records that arrived only when fetched again, by topic'
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
        None, description='whether it did everything that the run asked of it; null if not known'
    )
    error: str | None = Field(None, description='why it gave up; null if it did not')


class CoreReport(Facts):
    """The facts that a core reports, over topics or in process."""

    refused: Counts = Field({}, description='records that it refused, by topic')
    lost: Counts = Field({}, description='records that were published and never arrived, by topic')
    duplicated: Counts = Field({}, description='records that arrived more than once, by topic')
    counters: Counts = Field({}, description='other counts, by their names in words')
    memory: MemoryFacts | None = Field(None, description='contents of its memory D')
    updates: int | None = Field(None, description='SAC updates taken')
    policy_sha256: str | None = Field(None, description="digest of the policy's weights")
    gradient_steps: int | None = Field(None, description='gradient steps of the reward model')
    reward_model_sha256: str | None = Field(
        None, description="digest of the reward model's weights"
    )
    reward_model: dict[str, str | float | list[float]] | None = Field(
        None, description='what the reward model states of itself, such as the kind of score'
    )
    started_from: StartedFrom | None = Field(
        None, description='the reward model that it started from, if not from scratch'
    )


class BagReport(Facts):
    """The recorder's further facts: what it has written, and how long the disk took."""

    recorded: Counts = Field({}, description='records that it wrote into the bag, by topic')
    different: Counts = Field(
        {},
        description='records that came again and were others than before, by topic: what '
        'published them is not deterministic',
    )
    bag: str | None = Field(None, description='folder of the bag that it wrote')
    bag_bytes: int | None = Field(None, description='size of the bag [bytes]')
    flush_seconds: float | None = Field(
        None, description='time to flush all phases to the disk [s]'
    )
    flush_ms: FlushTimes | None = Field(None, description='time to flush a phase to the disk')


class NodeReport(BagReport, CoreReport, _Wired):
    """The report of a node, or of a part of a run in one process, at its end."""

    exit_code: int | None = Field(
        None,
        description='exit code of its process; not in the file, since its parent process adds it',
    )
    restarts: int | None = Field(
        None, description='how often it was started again; its parent process adds it'
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
    """The report of a node, or of a part of a run in one process.

    Args:
        core: the report of its core.
        role: one of `records.ROLES`.
        name: name of the node.
        published: records that it published, by topic.
        received: records that reached it, by topic.
        refused: records refused before they reached the core, which adds its own refusals.
        lost: records that never arrived, by topic; None in a run without topics.
        fetched: records that arrived when fetched again; None in a run without topics.
        cpu_s: processor time [s].
        wall_s: time from start to end [s].
        finished: whether it did everything that the run asked of it.
        error: why it gave up; None if it did not.
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
    """The known facts, as they are written."""
    return facts.model_dump(mode='json', exclude_unset=True)


def write(path: Path, report: NodeReport) -> None:
    """Write a node's report; `folder.report_path` gives the path."""
    make_folder(path.parent)
    atomic_write(path, json.dumps(_known(report), indent=2) + '\n')


def read(path: Path) -> NodeReport:
    """Read a node's report.

    Raises:
        RunFolderError: it is damaged, or not a node's report.
    """
    return facts.read(
        NodeReport, path, 'node report', 'remove the file, a summary can do without it'
    )


def has_finished(folder: Path, role: str, name: str | None = None) -> bool:
    """Whether a node has done everything, by the report that it has left.

    Args:
        folder: of the run.
        role: the node's role.
        name: its name; None: that of its role.
    """
    path = run_folder.report_path(folder, role, name or role)
    return path.is_file() and read(path).finished is True


def read_all(folder: Path) -> dict[str, NodeReport]:
    """Read all node reports of a run, by `<role>-<name>`.

    Raises:
        RunFolderError: one of them is damaged.
    """
    paths = sorted((folder / run_folder.NODES).glob('*.json'))
    return {path.stem: read(path) for path in paths}
