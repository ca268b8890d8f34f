"""A simulator: rolls out the steps that each policy permits, and publishes what happened."""

import hashlib
import logging
import time
from collections import Counter
from collections.abc import Iterator

from codetr_ros.config import Settings
from codetr_ros.cores.core import Part
from codetr_ros.cores.left_out import is_left_out
from codetr_ros.policy.acting import ActingPolicy
from codetr_ros.records import (
    TOPICS,
    Commit,
    Metrics,
    Policy,
    Record,
    RecordError,
    RunSpec,
    Transitions,
    describe,
    metrics,
)
from codetr_ros.records.roles import subscribed
from codetr_ros.runs.reports import CoreReport
from codetr_ros.simulation.permission import acting_policy, check_policy
from codetr_ros.simulation.scorer import ScoreScale
from codetr_ros.simulation.source import Source

_log = logging.getLogger(__name__)


class Simulator(Part):
    """Rolls out a task under the policies that it receives, in the order of their phases.

    With the setting `envs` above 1 it has that many environments. Each is a source of its own:
    with its own name, seeds, episodes and sequence numbers, like that of another simulator.
    So no receiver, bag, check or player needs to know which process steps come from, and the
    memory D still has one open episode for each source. The environments share the process, the
    policy and the turn: a slice is one chunk of each, in the order of their names. Threads do not
    pay: the parts of a step that release the interpreter lock are too short (measured with eight
    environments and 16 cores, docs/decisions).

    Args:
        run: the run it belongs to.
        settings: the settings of the run.
        name: its name, which must differ from every other simulator's of the run.

    Raises:
        TaskError: the task is unknown or cannot be used.
        SettingsError: the delay exceeds the task's horizon.
    """

    subscribes = subscribed('sim')

    def __init__(self, run: RunSpec, settings: Settings, name: str) -> None:
        super().__init__()
        self._run = run
        self._settings = settings
        self._name = name
        self._scale = ScoreScale.of(settings)
        self._sources = self._made()
        self._waiting: dict[int, tuple[Policy, ActingPolicy | None]] = {}
        self._phase = 0  # the next to be run
        self._resumed = False
        self._ran = False  # whether it has taken steps since it began or went on
        self._left_out = False  # of the phase before, or of some before that
        self._first = 0  # that is run in this process: those before it were run in another
        self._known: dict[int, tuple[int, bytes, bytes]] = {}  # what was permitted, by phase
        self._counters: Counter[str] = Counter()
        self._closed = False

    def _made(self) -> list[Source]:
        return [
            Source(self._run, self._settings, each, self._scale)
            for each in self._settings.sources_of(self._name)
        ]

    @property
    def displaced(self) -> bool:
        """Whether it is permitted to go on after it was left out: its place in the run is then
        what was recorded of it. It waits for `begin_anew`, `restore` and `resume`.
        """
        policy, _ = self._waiting.get(self._phase, (None, None))
        return self._left_out and policy is not None and self._permits(policy)

    def _permits(self, policy: Policy) -> bool:
        return bool(policy.steps.any()) and not is_left_out(
            self._settings, policy, (each.name for each in self._sources)
        )

    def begin_anew(self) -> None:
        """Forget the episodes that are under way: some of their steps were dropped.

        Raises:
            TaskError: an environment is at fault.
        """
        for source in self._sources:
            source.close()
        self._sources = self._made()
        self._left_out = self._ran = False

    def restore(self, record: Record) -> None:
        """Take one of the records that it has published before, in order: transitions, true
        rewards and scores of committed phases, without those that were dropped, and commits.
        Those of other sources, and other kinds, are passed over.
        """
        for source in self._sources:
            dropped = isinstance(record, Commit) and set(record.dropped) & set(record.sources)
            if isinstance(record, Commit) and dropped and source.name in dropped:
                last = dict(zip(record.sources, record.transitions.tolist(), strict=True))
                scores = dict(zip(record.scorers, record.scores.tolist(), strict=True))
                source.skip(last[source.name], scores.get(source.name))
            if getattr(record, 'source', None) == source.name:
                source.restore(record)

    def resume(self, phase: int) -> None:
        """Go on behind what was restored. Call it before `work`, if at all.

        Each environment is brought back to where it was: reset with the episode's seed it takes
        the recorded actions again. Where it then does something else than recorded, its episode
        ends as truncated with the next phase; that is logged and counted.

        Args:
            phase: the next to be run: the first that is not committed.

        Raises:
            TaskError: an environment is at fault.
        """
        self._phase = self._first = phase
        self._resumed = True
        # behind the last phase nothing is left to be permitted, and the learner may be gone
        self.finished = phase >= self._settings.phases
        self._counters['phases'] = phase
        for source in self._sources:
            source.resume()

    def wait_for_place(self, phase: int) -> None:
        """Begin in a run that goes on without this simulator, and wait until it is let in. Call it
        before `work`, if at all.

        Args:
            phase: the first that is not committed.
        """
        self._phase = self._first = phase
        self._resumed = True
        self.finished = phase >= self._settings.phases
        self._note_left_out(0)

    @property
    def is_new(self) -> bool:
        """Whether nothing of it has ever been recorded or voided."""
        return not any(source.has_begun for source in self._sources)

    def receive(self, record: Record) -> None:
        """Keep a policy until its phase's turn.

        Raises:
            RecordError: it is of another run, its phase has been run or is waiting, it names no
                steps for a source of this simulator, or its weights do not fit; nothing has
                changed then.
        """
        policy = check_policy(record, self._run, self._settings, f'simulator {self._name!r}')
        ends = not policy.steps.any()
        if ends and self.finished:
            return  # with overlap two policies permit nothing; the second serves the evaluator
        if policy.phase < self._first or self._known.get(policy.phase) == _content(policy):
            self.duplicated[TOPICS[Policy]] += 1  # of a learner that was started again
            return
        if policy.phase < self._phase or policy.phase in self._waiting:
            done = 'run' if policy.phase < self._phase else 'received'
            raise RecordError(
                f'{describe(policy)}: {self._name!r} has {done} phase={policy.phase} already: '
                'each phase must be permitted once. Stop the second learner, if there is one'
            )
        for source in self._sources:
            if not ends and source.name not in policy.sources:
                needed = len(policy.sources) // self._settings.envs + 1
                raise RecordError(
                    f'{describe(policy)} names sources={list(policy.sources)}, not '
                    f'{source.name!r}: start the run with simulators={needed}, or stop this one'
                )
        environment = self._sources[0].environment
        acting = None if ends else acting_policy(policy, environment, self._settings)
        self._waiting[policy.phase] = policy, acting
        self._known[policy.phase] = _content(policy)

    @property
    def lacks_permission(self) -> bool:
        """Whether it waits for the policy of the next phase to be run."""
        return not self.finished and self._phase not in self._waiting

    @property
    def unpermitted(self) -> int | None:
        """The phase whose policy is awaited; None if it has come, or none is."""
        return self._phase if self.lacks_permission else None

    @property
    def due(self) -> int:
        """The next phase to be run."""
        return self._phase

    def waiting_for(self) -> str:
        """What the next slice waits for, for people."""
        return f'permission for phase {self._phase} from the learner'

    def work(self) -> Iterator[list[Record] | None]:
        """Yield what is simulated, then per slice a chunk of each source, of at most `CHUNK_STEPS`
        steps.
        """
        yield [source.spec() for source in self._sources]
        while not self.finished:
            self._pass_over_lost()
            if self._phase not in self._waiting or self.displaced:
                yield None
                continue
            policy, acting = self._waiting.pop(self._phase)
            self._phase += 1
            if not policy.steps.any():
                self.finished = True
            elif not self._permits(policy):
                self._note_left_out(1)
                yield [source.spec() for source in self._sources]  # it is there: let it in
            else:
                self._ran = True
                yield from self._run_phase(policy, acting)
        while True:
            yield None

    def _pass_over_lost(self) -> None:
        """Pass over phases whose policy never came to a simulator that has joined late, and that
        are committed: a newer policy was published after them.
        """
        committed = max(self._waiting, default=-1) - self._settings.lag
        joined_late = self._resumed and not self._ran
        if not joined_late or self._phase in self._waiting or committed < self._phase:
            return
        self.pass_over(committed + 1)

    def pass_over(self, phase: int) -> None:
        """Go on with a phase: those before it are committed without this simulator. Behind the
        last it has finished.
        """
        self._note_left_out(phase - self._phase)
        self._phase = phase
        self.finished = phase >= self._settings.phases
        for before in [before for before in self._waiting if before < phase]:
            del self._waiting[before]

    def _note_left_out(self, phases: int) -> None:
        if not self._left_out:
            _log.log(
                logging.WARNING if self._ran else logging.INFO,
                '%s takes no part in the run now: it goes on where what was recorded of it ends, '
                'as soon as it is permitted to', self._name,
            )  # fmt: skip
        self._left_out = True
        self._counters['phases left out'] += phases

    def _run_phase(self, policy: Policy, acting: ActingPolicy | None) -> Iterator[list[Record]]:
        going = [
            source.roll_out(policy, acting) for source in self._sources if source.permitted(policy)
        ]
        seconds = 0.0
        while going:
            began = time.perf_counter()
            chunks = [next(rollout) for rollout in going]
            seconds += time.perf_counter() - began
            going = [
                rollout
                for rollout, records in zip(going, chunks, strict=True)
                if not _transitions(records).phase_end
            ]
            records = [record for chunk in chunks for record in chunk]
            if not going:
                self._counters['phases'] += 1
                records.append(self._metrics(policy.phase, seconds))
            yield records

    def _metrics(self, phase: int, seconds: float) -> Metrics:
        step = self._settings.steps_after(phase)
        values = {'simulate_seconds': seconds} | self._scale.metrics()
        return metrics(self._run.run_id, 'sim', self._name, phase, step, values)

    def close(self) -> None:
        """Close the environments. A simulator keeps no checkpoint."""
        if not self._closed:
            self._closed = True
            for source in self._sources:
                source.close()

    def report(self) -> CoreReport:
        """Counts for the run's summary."""
        counters = self._counters.copy()
        for source in self._sources:
            counters.update(source.counters)
        return CoreReport(lost={}, duplicated=dict(self.duplicated), counters=dict(counters))


def _content(policy: Policy) -> tuple[int, bytes, bytes]:
    """What a policy permits, and a digest of its weights."""
    return policy.version, policy.steps.tobytes(), hashlib.sha256(policy.weights).digest()


def _transitions(records: list[Record]) -> Transitions:
    """The transitions among the records of a chunk: its first record."""
    first = records[0]
    assert isinstance(first, Transitions)
    return first
