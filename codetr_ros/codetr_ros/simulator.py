"""A simulator: rolls out the steps that each policy permits and says what happened."""

import time
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np

from codetr_ros.config import Settings
from codetr_ros.learners.network import ActingPolicy
from codetr_ros.records import (
    F32,
    PROTOCOL_VERSION,
    CompositeReward,
    Metrics,
    Policy,
    Record,
    RecordError,
    RunSpec,
    TaskSpec,
    Transitions,
    TrueRewards,
    describe,
    metrics,
)
from codetr_ros.rollout import Episode, Score, acting_policy, check_policy, uniform_actions
from codetr_ros.seeding import generator
from codetr_ros.tasks import TaskError, make, r_max

CHUNK_BYTES = 200_000
"""Most bytes of a chunk: the middleware's shared-memory segment holds 512 KB."""
CHUNK_STEPS = 250
"""Most steps of a chunk: bounds how long a slice of work takes, so how quickly a node answers."""


def chunk_steps(observation_size: int, action_size: int) -> int:
    """Most steps T of a chunk, so that (T+1, O) and (T, A) float32 fit; 0 if no step does."""
    numbers = CHUNK_BYTES // 4
    fitting = (numbers - observation_size) // (observation_size + action_size)
    return max(0, min(CHUNK_STEPS, fitting))


class Simulator:
    """Rolls out a task under the policies that it receives, in the order of their phases.

    What it draws depends on the run's seed, its own name, the phase and the episode, and on
    nothing else.

    Args:
        run: the run it belongs to.
        settings: the settings of the run.
        source: its name, which must differ from every other simulator's of the run.

    Raises:
        TaskError: the task is unknown or cannot be used.
        SettingsError: the delay exceeds the task's horizon.
    """

    subscribes: tuple[type, ...] = (Policy,)

    def __init__(self, run: RunSpec, settings: Settings, source: str) -> None:
        self._run = run
        self._settings = settings
        self._source = source
        self._environment = make(settings.task)
        self._episode = Episode(self._environment, settings)
        self._chunk_steps = chunk_steps(
            self._environment.observation_size, self._environment.action_size
        )
        if not self._chunk_steps:
            raise TaskError(
                f'task {settings.task!r}: one step with {self._environment.observation_size} '
                f'observations and {self._environment.action_size} actions takes more than the '
                f'{CHUNK_BYTES} bytes of a message: choose a task with smaller observations'
            )
        self._waiting: dict[int, tuple[Policy, ActingPolicy | None]] = {}
        self._phase = 0  # the next to be run
        self._episodes = -1  # the number of the one that runs
        self._sequence = 0  # of the next chunk
        self._scores = 0  # scores given so far: the sequence number of the next
        self._counters: Counter[str] = Counter()
        self._closed = False
        self.finished = False

    def receive(self, record: Record) -> None:
        """Keep a policy until its phase's turn.

        Raises:
            RecordError: it is of another run, its phase has been run or is waiting, it names no
                steps for this source, or its weights do not fit. Nothing has changed.
        """
        policy = check_policy(record, self._run, self._settings, f'simulator {self._source!r}')
        ends = not policy.steps.any()
        if ends and self.finished:
            return  # with overlap two permit nothing; the second one serves the evaluator
        if policy.phase < self._phase or policy.phase in self._waiting:
            done = 'run' if policy.phase < self._phase else 'received'
            raise RecordError(
                f'{describe(policy)}: {self._source!r} has {done} phase={policy.phase} already: '
                'each phase must be permitted once. Stop the second learner, if there is one'
            )
        if not ends and self._source not in policy.sources:
            raise RecordError(
                f'{describe(policy)} names sources={list(policy.sources)}, not {self._source!r}: '
                f'start the run with simulators={len(policy.sources) + 1}, or stop this one'
            )
        self._waiting[policy.phase] = (
            policy,
            None if ends else acting_policy(policy, self._environment, self._settings.delay),
        )

    def work(self) -> Iterator[list[Record] | None]:
        """One chunk per slice, of at most `CHUNK_STEPS` steps; first of all what is simulated."""
        yield [self._task_spec()]
        while not self.finished:
            policy, acting = self._waiting.pop(self._phase, (None, None))
            if policy is None:
                yield None
                continue
            self._phase += 1
            if not policy.steps.any():
                self.finished = True
            elif steps := int(policy.steps[policy.sources.index(self._source)]):
                yield from self._run_phase(policy, acting, steps)
        while True:
            yield None

    def _task_spec(self) -> TaskSpec:
        environment = self._environment
        return TaskSpec(
            self._run.run_id,
            PROTOCOL_VERSION,
            self._source,
            self._settings.task,
            environment.observation_size,
            environment.action_size,
            environment.horizon,
            environment.control_period,
            r_max(self._settings, environment),
        )

    def _run_phase(
        self, policy: Policy, acting: ActingPolicy | None, steps: int
    ) -> Iterator[list[Record]]:
        # for the whole phase at once: where its chunks begin and end does not change what is drawn
        rng = generator(self._settings.seed, 'noise', self._source, policy.phase)
        size = self._environment.action_size
        draws = (
            uniform_actions(rng, steps, size)
            if acting is None
            else rng.standard_normal((steps, size), dtype=np.float32)
        )
        taken, seconds, scores_before = 0, 0.0, self._scores
        while taken < steps:
            began = time.perf_counter()
            if self._episode.over:
                self._episodes += 1
                seeds = generator(self._settings.seed, 'reset', self._source, self._episodes)
                self._episode.reset(int(seeds.integers(2**31)))
            done, records = self._roll_out(policy, acting, draws[taken:], taken, scores_before)
            taken += done
            seconds += time.perf_counter() - began
            if taken == steps:
                self._counters['phases'] += 1
                records.append(self._metrics(policy.phase, seconds))
            yield records

    def _roll_out(
        self,
        policy: Policy,
        acting: ActingPolicy | None,
        draws: F32,
        taken: int,
        scores_before: int,
    ) -> tuple[int, list[Record]]:
        """One chunk: its number of steps, and its records.

        Args:
            policy: the permission.
            acting: the policy to act with; None acts as drawn.
            draws: (steps left in the phase, A) noise, or actions where the policy is random.
            taken: steps of the phase taken before.
            scores_before: scores given before the phase.
        """
        episode, environment = self._episode, self._environment
        first_step = episode.length
        most = min(len(draws), self._chunk_steps, environment.horizon - first_step)
        observations = np.empty((most + 1, environment.observation_size), np.float32)
        actions = draws[:most].copy()
        rewards = np.empty(most, np.float32)
        scores: list[Score] = []
        observations[0] = episode.observation
        t = 0
        while t < most and not episode.over:
            if acting is not None:
                actions[t] = acting.act(episode.observation, draws[t], episode.length)
            rewards[t], score = episode.step(actions[t])
            t += 1
            observations[t] = episode.observation
            if score is not None:
                scores.append(score)
        run_id, source, number = self._run.run_id, self._source, self._episodes
        sequence = self._sequence
        phase_end = t == len(draws)
        chunk = Transitions(
            run_id,
            source,
            sequence,
            policy.phase,
            number,
            first_step,
            t,
            observations[: t + 1],
            actions[:t],
            episode.terminated,
            episode.truncated,
            phase_end,
            self._scores + len(scores) - scores_before if phase_end else 0,
        )
        records: list[Record] = [
            chunk,
            TrueRewards(run_id, source, sequence, policy.phase, number, first_step, rewards[:t]),
        ]
        for score in scores:
            records.append(
                CompositeReward(
                    run_id,
                    source,
                    source,
                    self._scores,
                    number,
                    score.first_step,
                    score.length,
                    score.value,
                )
            )
            self._scores += 1
        self._sequence += 1
        self._counters.update(chunks=1, steps=t, scores=len(scores))
        if episode.over:
            self._counters['episodes'] += 1
            step = self._steps_at(policy, taken + t)
            records.append(
                episode.result(run_id, source, 'training', step, policy.version, number)
            )
        return t, records

    def _steps_at(self, policy: Policy, taken: int) -> int:
        """Steps of the run, as if all sources were as far in the phase as this one."""
        share = taken / int(policy.steps[policy.sources.index(self._source)])
        return policy.phase * self._settings.phase_steps + round(share * int(policy.steps.sum()))

    def _metrics(self, phase: int, seconds: float) -> Metrics:
        step = self._settings.steps_after(phase)
        values = {'simulate_seconds': seconds}
        return metrics(self._run.run_id, 'sim', self._source, phase, step, values)

    def close(self) -> None:
        """Close the environment. A simulator keeps no checkpoint."""
        if not self._closed:
            self._closed = True
            self._environment.close()

    def report(self) -> dict[str, Any]:
        """Counts for the run's summary."""
        return {'lost': {}, 'duplicated': {}, 'counters': dict(self._counters)}
