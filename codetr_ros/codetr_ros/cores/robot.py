"""A robot in place of a simulator: it acts under the policies that it receives, and publishes what
it did.

At the pace `permitted` it takes the steps of a phase once they are permitted, and is held by the
safe command meanwhile. At the pace `free` it goes on under its newest policy. A policy that
arrives is used from the next control step on: nothing changes within one.
"""

import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from codetr_ros.config import Settings, SettingsError
from codetr_ros.cores.core import Part
from codetr_ros.policy.acting import ActingPolicy, uniform_actions
from codetr_ros.records import (
    F32,
    INITIAL_VERSION,
    PROTOCOL_VERSION,
    Commit,
    CompositeReward,
    Metrics,
    Policy,
    Record,
    RecordError,
    RunSpec,
    TaskSpec,
    Transitions,
    describe,
    metrics,
)
from codetr_ros.records.digests import digest
from codetr_ros.records.roles import subscribed
from codetr_ros.robots import mapping
from codetr_ros.robots.driving import MISSED, Driving
from codetr_ros.robots.guard import Hold
from codetr_ros.robots.live_scores import LiveScores, scoring
from codetr_ros.robots.steplog import StepLog
from codetr_ros.runs.reports import CoreReport
from codetr_ros.seeding import generator
from codetr_ros.simulation.permission import acting_policy, check_policy

PERMISSION, BEHIND, FINISHED = 'permission', 'learner behind', 'end of the run'


@dataclass(frozen=True)
class Stage:
    """The robot as a task.

    Attributes:
        name: the name of the task.
        observation_size: O.
        action_size: A.
        horizon: steps after which an episode is cut off.
    """

    name: str
    observation_size: int
    action_size: int
    horizon: int


class Robot(Part):
    """Drives a robot under the policies that it receives.

    A control step is taken by `work` once it is due by the clock. `driving` is what the driver of
    the robot is connected to.

    Args:
        run: the run it belongs to.
        settings: the settings of the run.
        name: its name, which is that of its source.
        rules: the mapping; its part `live` must be there.
        clock: seconds, never going back.

    Raises:
        SettingsError: the task is that of a simulation, the mapping has no part `live`, or the
            delay exceeds its episodes.
    """

    subscribes = subscribed('sim')

    def __init__(
        self,
        run: RunSpec,
        settings: Settings,
        name: str,
        rules: mapping.Mapping,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__()
        if not settings.on_robot:
            raise SettingsError(
                f'task = {settings.task}: a robot node needs the task of a robot, robot/NAME; '
                'start `ros2 run sim_node sim` for a simulation, or the learner with another task'
            )
        if rules.live is None:
            raise SettingsError(
                'the mapping has no part `live`, which a robot node needs: docs/your-robot.md has '
                'an example'
            )
        self._live = rules.live
        if settings.within(self._live.episode_steps).longest > self._live.episode_steps:
            raise SettingsError(
                f'delay = {settings.delay}: episodes of the robot have '
                f'{self._live.episode_steps} steps (live.episode_steps); choose a shorter delay'
            )
        self._run = run
        self._settings = settings
        self._name = name
        self._log = StepLog(run.run_id, name, settings.steps_of)
        rules = scoring(rules, settings, name)
        self._scores = LiveScores(rules, run.run_id, name, settings.cuts, lambda: self._log.phase)
        self.driving = Driving(rules, self, self._log, clock, self._scores)
        self.senses, self.control = self.driving.senses, self.driving.control
        self._permitted: dict[int, tuple[Policy, ActingPolicy | None]] = {}
        self._now: tuple[Policy, ActingPolicy | None] | None = None  # under which it acts
        self._newest: tuple[Policy, ActingPolicy | None] | None = None
        self._last: Policy | None = None  # the one that permits nothing more
        self._early: deque[Policy] = deque(maxlen=settings.ahead + 1)  # before the robot is known
        self._known: dict[int, str] = {}  # digests of those that have permitted a phase
        self._first = 0  # phase of this process: those before it were another's
        self._restarted = False
        self.versions: Counter[int] = Counter()  # steps begun under each policy

    # ---- records

    @property
    def stage(self) -> Stage:
        """The robot as a task; its sizes are known once each topic has brought something."""
        return Stage(
            self._settings.task,
            self.senses.size,
            self.control.limiter.size,
            self._live.episode_steps,
        )

    def receive(self, record: Record) -> None:
        """Keep a policy until its phase's turn; at a free pace until the next control step.

        Raises:
            RecordError: it is of another run, names no steps for this robot, comes twice, or its
                weights do not fit; nothing has changed then.
        """
        policy = check_policy(record, self._run, self._settings, f'robot {self._name!r}')
        if not policy.steps.any():
            self._last = policy
            return
        if self._name not in policy.sources:
            raise RecordError(
                f'{describe(policy)} names sources={list(policy.sources)}, not {self._name!r}: '
                'stop the other robot or simulator'
            )
        if not self.senses.size:  # a node before this one was announced: it was killed
            self._early.append(policy)
            return
        self._take(policy)

    def _take(self, policy: Policy) -> None:
        made = policy, acting_policy(policy, self.stage, self._settings)
        if self._settings.free:
            if self._newest is None or policy.phase > self._newest[0].phase:
                self._newest = made
            else:
                self.duplicated['policy'] += 1
            return
        if policy.phase < self._first or self._known.get(policy.phase) == digest(policy):
            self.duplicated['policy'] += 1  # of a robot, or a learner, that was started again
            return
        if policy.phase < self._log.phase or policy.phase in self._permitted:
            raise RecordError(
                f'{describe(policy)}: {self._name!r} has phase={policy.phase} already: each phase '
                'must be permitted once. Stop the second learner, if there is one'
            )
        self._permitted[policy.phase] = made
        self._known[policy.phase] = digest(policy)

    def restore(self, records: Sequence[Record]) -> None:
        """Go on behind what a node of this name has published before it was killed.

        A robot cannot be set back. Its episode is over, and the steps that it took since then are
        nobody's.

        Args:
            records: transitions, scores and commits of the last committed phase, then all since.
        """
        self._log.restore(record for record in records if isinstance(record, Transitions))
        self._first = self._log.phase
        self._restarted = bool(records)
        for record in records:
            if isinstance(record, CompositeReward) and record.scorer == self._name:
                self._scores.resume(record.sequence + 1)
            elif isinstance(record, Commit) and self._name in record.scorers:
                last = int(record.scores[record.scorers.index(self._name)])
                self._scores.resume(last + 1)

    def begun(self) -> str:
        """How far the run has come, in words."""
        return f'phase {self._log.phase}, {self._log.total} steps are taken'

    def _spec(self) -> TaskSpec:
        stage, r_max = self.stage, self._settings.r_max
        return TaskSpec(
            run_id=self._run.run_id,
            protocol_version=PROTOCOL_VERSION,
            source=self._name,
            task=stage.name,
            observation_size=stage.observation_size,
            action_size=stage.action_size,
            horizon=stage.horizon,
            control_period=self._live.period,
            r_max=1.0 if r_max is None else r_max,
        )

    # ---- the loop

    def work(self) -> Iterator[list[Record] | None]:
        """Yield what the robot is, then the records of each control step that was due."""
        while not self.senses.size:
            yield None
        yield [self._spec()]
        while self._early:
            self._take(self._early.popleft())
        self.driving.begin()
        while not self.finished:
            yield self._given(self.driving.step()) or None
            if self._last is not None and self._log.phase >= self._settings.phases:
                yield self._given(self.driving.deactivate())
                self.finished = True
        while True:
            yield None

    def _given(self, records: list[Transitions]) -> list[Record]:
        """Records and scores, and the metrics of each phase that ends with them."""
        ended = [record.phase for record in records if record.phase_end]
        return [*records, *self._scores.taken(), *map(self._metrics, ended)]

    def _choose(self) -> None:
        """Take the newest policy, or the one of the phase that the next step belongs to."""
        if self._settings.free:
            self._now = self._newest
        else:
            phase = self._next_phase
            self._permitted = {k: each for k, each in self._permitted.items() if k >= phase - 1}
            self._now = self._permitted.get(phase)

    @property
    def _next_phase(self) -> int:
        """The phase that the next step belongs to."""
        return self._log.phase + (self._log.left <= 0)

    @property
    def _behind(self) -> bool:
        """Whether a robot at its free pace must wait for a newer policy than the newest."""
        log, settings = self._log, self._settings
        assert self._newest is not None
        learnt = max(self._newest[0].version, INITIAL_VERSION)
        return log.total // settings.phase_steps > learnt + settings.ahead

    @property
    def unpermitted(self) -> int | None:
        """The phase whose policy is awaited, without which no further step is taken; once all
        are, that of the policy which permits nothing more. None if none is awaited.
        """
        settings = self._settings
        if self.finished or not self.senses.size:
            return None
        if self._log.total >= settings.steps:
            return settings.phases if self._last is None else None
        if not settings.free:
            return None if self._next_phase in self._permitted else self._next_phase
        if self._newest is None:
            return 0
        return self._newest[0].phase + 1 if self._behind else None

    # ---- for the control

    def withheld(self) -> Hold | None:
        """Choose the policy of this control step; returns why none acts, or None if one does."""
        self._choose()
        settings, log = self._settings, self._log
        if log.total >= settings.steps:
            return Hold(FINISHED, 'all steps of the run are taken')
        if self._now is None:
            return Hold(PERMISSION, 'no policy permits a step')
        if settings.free and self._behind:
            return Hold(
                BEHIND,
                f'the learner is {settings.ahead} phases behind: its newest policy has learnt '
                f'from phase {self._now[0].version}',
            )
        return None

    def act(self, observation: F32, step: int) -> F32:
        """The action for an observation, under the policy of this control step."""
        assert self._now is not None
        policy, acting = self._now
        self.versions[policy.version] += 1
        rng = generator(self._settings.seed, 'noise', self._name, self._log.total)
        size = self.control.limiter.size
        if acting is None:
            drawn: F32 = uniform_actions(rng, 1, size)[0]
            return drawn
        return acting.act(observation, rng.standard_normal(size, dtype=np.float32), step)

    # ---- reports

    def waiting_for(self) -> str:
        """What the robot waits for, for people."""
        return self.driving.waiting_for()

    def _metrics(self, phase: int) -> Metrics:
        step = self._settings.steps_after(phase)
        values = self.driving.deadlines.metrics()
        values['episodes'] = float(self.control.counts['episodes'])
        if self._now is not None:
            values['policy_version'] = float(self._now[0].version)
        return metrics(self._run.run_id, 'sim', self._name, phase, step, values)

    def close(self) -> None:
        """Leave the robot with the safe command."""
        self.driving.close()

    def report(self) -> CoreReport:
        """Counts for the run's summary."""
        counters = self.driving.counts() + self._scores.report()
        counters['steps'] = self._log.total
        counters['times that the node was started again'] = self._restarted
        counters['policies used'] = len(self.versions)
        shown = {name: count for name, count in counters.items() if count}
        shown[MISSED] = self.driving.deadlines.missed  # none, too
        return CoreReport(duplicated=dict(self.duplicated), counters=shown)


def load_rules(path: str) -> mapping.Mapping:
    """Read the mapping of a robot node.

    Raises:
        SettingsError: no file was named, or it is not sound.
    """
    if not path:
        raise SettingsError(
            'a robot node needs the parameter mapping, the file that names the topics of the '
            'robot: docs/your-robot.md has an example'
        )
    return mapping.load(Path(path))
