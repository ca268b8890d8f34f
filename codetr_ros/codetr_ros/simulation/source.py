"""A source: one environment whose episodes become records, chunk by chunk."""

import logging
import math
from collections import Counter
from collections.abc import Iterator

import numpy as np

from codetr_ros.config import Settings
from codetr_ros.policy.acting import ActingPolicy, uniform_actions
from codetr_ros.records import (
    F32,
    PROTOCOL_VERSION,
    CompositeReward,
    Policy,
    Record,
    RunSpec,
    TaskSpec,
    Transitions,
    TrueRewards,
)
from codetr_ros.seeding import generator, seed_global
from codetr_ros.simulation.chunks import steps_of_chunks
from codetr_ros.simulation.episode import EpisodeRunner, Score
from codetr_ros.simulation.open_episode import DiffersError, OpenEpisode
from codetr_ros.simulation.scorer import Scorer, ScoreScale
from codetr_ros.simulation.tasks import make, r_max

_log = logging.getLogger(__name__)


class Source:
    """Runs one episode after another in an environment of its own.

    Its draws depend only on the run's seed, its own name, the phase and the episode.

    Args:
        run: the run it belongs to.
        settings: the settings of the run.
        name: its name, which no other source of the run may have.
        scale: of the task's scores; None: measured here.

    Raises:
        TaskError: the task is unknown or cannot be used.
        SettingsError: the delay exceeds the task's horizon.
    """

    def __init__(
        self, run: RunSpec, settings: Settings, name: str, scale: ScoreScale | None = None
    ) -> None:
        self.name = name
        scale = ScoreScale.of(settings) if scale is None else scale
        self._scorer = Scorer(settings, scale, name)
        seed_global(settings.seed, 'environment')  # one environment, whoever makes it
        self.environment = make(settings.task)
        self.counters: Counter[str] = Counter()
        self._run = run
        self._settings = settings
        self._episode = EpisodeRunner(self.environment, settings, name)
        self._chunk_steps = steps_of_chunks(self.environment)
        self._episodes = -1  # number of the present one
        self._sequence = 0  # of the next chunk
        self._scores = 0  # scores given so far: the sequence number of the next
        self._recorded = OpenEpisode(settings, name)
        self._lost = False  # whether the episode recorded last cannot be gone on with

    def spec(self) -> TaskSpec:
        """The announcement of what this source simulates."""
        environment = self.environment
        return TaskSpec(
            run_id=self._run.run_id,
            protocol_version=PROTOCOL_VERSION,
            source=self.name,
            task=self._settings.task,
            observation_size=environment.observation_size,
            action_size=environment.action_size,
            horizon=environment.horizon,
            control_period=environment.control_period,
            r_max=r_max(self._settings, environment),
        )

    def restore(self, record: Record) -> None:
        """Take what this source has published before: chunks, true rewards and scores, in order.

        Without true rewards only observations are compared by `resume`.
        """
        self._recorded.take(record)

    @property
    def has_begun(self) -> bool:
        """Whether it has published any steps, or numbers of it were voided."""
        return self._sequence > 0

    def skip(self, sequence: int, scores: int | None) -> None:
        """Go on behind numbers that are voided, because this source was left out of a phase.

        Args:
            sequence: the last voided one of chunks.
            scores: the last voided one of scores; None: this source gives none.
        """
        self._recorded.sequence = sequence + 1
        if scores is not None:
            self._recorded.scores = scores + 1

    def resume(self) -> None:
        """Go on where what was restored ends: the episode that was under way is under way again.

        Where the environment does something else than recorded, that episode ends as truncated:
        what ends it is published with the next phase, is logged, and is counted.

        Raises:
            TaskError: the environment is at fault.
        """
        before = self._recorded
        self._episodes, self._sequence, self._scores = (
            before.episode, before.sequence, before.scores,
        )  # fmt: skip
        self.counters = +before.counters
        if not before.steps:
            return
        try:
            before.go_through(self._episode, self._scorer)
        except DiffersError as error:
            _log.error(
                '%s: the environment cannot be brought back to step %s of episode %s: %s. It is '
                'not deterministic: the episode ends there as truncated',
                self.name,
                before.steps,
                before.episode,
                error,
            )
            self.counters['episodes cut short, as the environment did not repeat them'] += 1
            self._lost = True

    def _abandoned(self, policy: Policy) -> list[Record]:
        """What ends an episode that cannot be gone on with; the next one follows on it."""
        if not self._lost:
            return []
        self._lost = False
        self.counters['episodes'] += 1
        number, before = self._episodes, self._recorded
        records: list[Record] = [
            self._score(score, given, number)
            for score, given in before.abandon(self._episode, self._scorer)
        ]
        self.counters['scores'] += len(records)
        if self._episode.length == before.steps:  # else not all of its rewards are known
            step = self._steps_at(policy, 0)
            run_id, version = self._run.run_id, policy.version
            records.append(
                self._episode.result(run_id, self.name, 'training', step, version, number)
            )
        return records

    def _score(self, score: Score, given: float, episode: int) -> CompositeReward:
        """The next score of this source."""
        if math.isnan(given):
            self.counters['scores missing'] += 1
        record = CompositeReward(
            run_id=self._run.run_id,
            source=self.name,
            scorer=self.name,
            sequence=self._scores,
            episode=episode,
            first_step=score.first_step,
            length=score.length,
            value=given,
        )
        self._scores += 1
        return record

    def roll_out(self, policy: Policy, acting: ActingPolicy | None) -> Iterator[list[Record]]:
        """Take the steps that a policy permits: the records of one chunk at a time, the chunk
        first.

        Args:
            policy: the permission, which gives this source at least one step.
            acting: the policy to act with; None acts uniformly at random.
        """
        steps = self.permitted(policy)
        # for the whole phase at once, so that the division into chunks does not change the draws
        rng = generator(self._settings.seed, 'noise', self.name, policy.phase)
        size = self.environment.action_size
        draws = (
            uniform_actions(rng, steps, size)
            if acting is None
            else rng.standard_normal((steps, size), dtype=np.float32)
        )
        taken, scores_before = 0, self._scores
        ending = self._abandoned(policy)
        while taken < steps:
            # others draw from them between two chunks
            seed_global(self._settings.seed, 'environment', self.name, policy.phase, taken)
            if self._episode.over:
                self._episodes += 1
                seeds = generator(self._settings.seed, 'reset', self.name, self._episodes)
                self._episode.reset(int(seeds.integers(2**31)), self._episodes)
                self._scorer.begin(self._episodes)
            done, records = self._chunk(policy, acting, draws[taken:], taken, scores_before)
            taken += done
            yield [records[0], *ending, *records[1:]]
            ending = []

    def permitted(self, policy: Policy) -> int:
        """Steps that a policy permits this source."""
        return int(policy.steps[policy.sources.index(self.name)])

    def _chunk(
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
        episode, environment = self._episode, self.environment
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
                actions[t] = acting.act(episode.observation, draws[t], episode.place)
            rewards[t], score = episode.step(actions[t])
            t += 1
            observations[t] = episode.observation
            if score is not None and not self._settings.scored_elsewhere:
                scores.append(score)
        run_id, source, number = self._run.run_id, self.name, self._episodes
        sequence = self._sequence
        phase_end = t == len(draws)
        chunk = Transitions(
            run_id=run_id,
            source=source,
            sequence=sequence,
            phase=policy.phase,
            episode=number,
            first_step=first_step,
            steps=t,
            observations=observations[: t + 1],
            actions=actions[:t],
            terminated=episode.terminated,
            truncated=episode.truncated,
            phase_end=phase_end,
            scores_due=self._scores + len(scores) - scores_before if phase_end else 0,
        )
        records: list[Record] = [
            chunk,
            TrueRewards(
                run_id=run_id,
                source=source,
                sequence=sequence,
                phase=policy.phase,
                episode=number,
                first_step=first_step,
                rewards=rewards[:t],
            ),
        ]
        for score in scores:
            records.append(self._score(score, self._scorer.given(score.value), number))
        self._sequence += 1
        self.counters.update(chunks=1, steps=t, scores=len(scores))
        if episode.over:
            self.counters['episodes'] += 1
            step = self._steps_at(policy, taken + t)
            records.append(
                episode.result(run_id, source, 'training', step, policy.version, number)
            )
        return t, records

    def _steps_at(self, policy: Policy, taken: int) -> int:
        """Steps of the run, as if all sources were as far in the phase as this one is."""
        share = taken / self.permitted(policy)
        return policy.phase * self._settings.phase_steps + round(share * int(policy.steps.sum()))

    def close(self) -> None:
        """Close the environment."""
        self.environment.close()
