"""What must be true of every simulated run, whatever happened in it."""

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from codetr_ros.bags.definitions import decode
from codetr_ros.bags.errors import BagError
from codetr_ros.bags.verify import Verdict, verify
from codetr_ros.nodes import errors
from codetr_ros.records import (
    TOPICS,
    Commit,
    CompositeReward,
    RecordError,
    StepRewards,
    Transitions,
)
from codetr_ros.records.digests import digest
from codetr_ros.simtest.process import Process

if TYPE_CHECKING:
    from codetr_ros.simtest.run import Simulated

COUNTED = tuple(TOPICS[kind] for kind in (Transitions, CompositeReward, StepRewards))
"""Topics of which every repeated message must be counted by a core that takes it."""
NEWS = 15.0
"""Seconds in which everybody knows that another node has ended."""
NO_TRUE_REWARDS = 'have no true rewards'
OF_A_CUT = ('without its index: its writer was killed', NO_TRUE_REWARDS)
"""What a bag may lack that was not closed. A commit does not wait for true rewards, from which
nobody learns."""


def early_commit(kind: type, raw: bytes, reader: Process, run: 'Simulated') -> str | None:
    """A commit that arrives before it would outlast a loss of power, in words."""
    if kind is not Commit:
        return None
    commit = decode(kind, raw)
    kept = run.recording.bag.commits.get(digest(commit))
    if commit.run_id != reader.run.run_id or (kept is not None and run.disk.holds(kept)):
        return None
    return f'a commit reaches {reader.name} before it is on the disk'


def at_the_end(run: 'Simulated') -> list[str]:
    """What is wrong after a run."""
    # who was left out and is killed is not started again once the run is over
    processes = [each for each in run.processes.values() if not each.killed]
    found = [*_unexplained(processes)]
    gave_up = [p for p in processes if not p.finished]
    if gave_up and run.plan.heals:
        reasons = '; '.join(f'{p.name}: {p.error}' for p in gave_up)
        found.append(f'gave up, though nothing happened that the run cannot mend: {reasons}')
    if run.plan.heals and not gave_up:
        found += _late(run)
    found += _weights(run)
    found += _uncounted(processes)
    found += _bag(run, whole=not gave_up)
    # what was dropped may have come too late for the bag; of the dead nobody knows the counts
    if not gave_up and not run.dropped() and not run.plan.kills:
        found += _unrecorded(run)
    return found


def _unexplained(processes: list[Process]) -> Iterator[str]:
    """Errors that are no refusals but faults of the program, and ends without a reason."""
    for each in processes:
        if each.error is not None and not errors.explains_itself(each.error):
            yield f'{each.name} fails by a fault: {type(each.error).__name__}: {each.error}'
        if not each.finished and each.error is None:
            yield f'{each.name} has ended and names no cause'


def _late(run: 'Simulated') -> Iterator[str]:
    """Nodes that stay though the recorder has ended, and nothing keeps the news from them."""
    over = run.recording.ended_at
    apart = sum(each.seconds for each in run.plan.weather.partitions)
    for each in run.processes.values():
        stalls = each.place.pace.stalls
        held = sum(seconds for begin, seconds in stalls if begin + seconds > over > begin - NEWS)
        if (seconds := each.ended_at - over) > apart + held + NEWS:
            yield f'{each.name} stays for {seconds:.0f} s though the recorder has ended'


def _weights(run: 'Simulated') -> Iterator[str]:
    """Learner and reward node, wherever they finished, have the weights of the undisturbed run."""
    try:
        expected = run.expected()
    except RecordError as error:
        yield f'what was recorded cannot be learnt from again: {error}'
        return
    for name, field in (('learner', 'policy_sha256'), ('reward', 'reward_model_sha256')):
        process = run.processes.get(name)
        if process is None or not process.core.finished:
            continue
        have = getattr(process.core.report(), field)
        want = expected.policy if name == 'learner' else expected.reward_model
        if have != want:
            yield f'{name} ends with other weights: {field} is {have}, undisturbed {want}'


def _uncounted(processes: list[Process]) -> Iterator[str]:
    """Messages that came twice, and that a core neither counts nor refuses."""
    for each in processes:
        if each.error is not None or each.place.instance > 1:  # that has counts of one before
            continue
        counted = Counter(each.core.duplicated) + each.traffic.refused + each.core.refused
        counted += each.set_aside
        read = {TOPICS[kind] for kind in each.core.subscribes}
        for topic in COUNTED:
            if topic in read and each.repeated[topic] > counted[topic]:
                yield (
                    f'{each.name} has taken {each.repeated[topic]} repeated messages on {topic}, '
                    f'and counts {counted[topic]}'
                )


def _unrecorded(run: 'Simulated') -> Iterator[str]:
    """Records that were published in a run that has finished, and are not in its bag; of nodes
    without which it has ended, some may be missing.
    """
    published: Counter[str] = Counter()
    excused: Counter[str] = Counter()
    for each in run.processes.values():
        published += each.published
        if each.name in run.recording.without:
            excused += each.published
    recorded = run.recording.bag.recorded
    for topic, count in published.items():
        if not count - excused[topic] <= recorded[topic] <= count:
            yield f'{count} records were published on {topic}, the bag has {recorded[topic]}'


def _bag(run: 'Simulated', whole: bool) -> Iterator[str]:
    """The bag holds what was learnt from, and is sound if the run has finished."""
    allowed = set() if whole else {'metadata', 'index'}
    if not run.recording.opened:
        allowed.add('file')  # its disk failed before the bag was made, or made whole again
    try:
        verdict = verify(run.folder)
    except BagError as error:
        if whole:
            yield f'the bag cannot be read: {error}'
        return
    excused = (() if whole else OF_A_CUT) + ((NO_TRUE_REWARDS,) if _lost_with_both(run) else ())
    yield from _findings(verdict, allowed, excused)


def _lost_with_both(run: 'Simulated') -> bool:
    """Whether true rewards may be lost for good: nobody learns from them, so that no commit waits
    for them, and a simulator that was killed publishes only those again that lie behind it.
    """
    dead = {death.name for death in run.plan.deaths}
    simulators = {each.name for each in run.processes.values() if each.role == 'sim'}
    return bool(dead & simulators) and _unheard(run)


def _unheard(run: 'Simulated') -> bool:
    """Whether messages have not reached the recorder."""
    killed = any(death.name == 'record' for death in run.plan.deaths)
    lost = any(reader == 'record' for reader, _ in run.post.network.lost)
    return killed or lost or run.plan.disk.kills_in is not None


def _findings(verdict: Verdict, allowed: set[str], excused: Sequence[str]) -> Iterator[str]:
    for finding in verdict.findings.named:
        known = any(text in finding.text for text in excused)
        if finding.kind not in allowed and not known:
            yield f'the bag is not sound: {finding.kind}: {finding.text}'
    for run in verdict.runs.values():
        if run.whole != run.phases:
            yield f'of {run.phases} committed phases in the bag {run.whole} are whole'
