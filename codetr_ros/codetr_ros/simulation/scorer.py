"""A scorer that is not exact: scores that are missing, noisy, or verdicts on an ordinal scale.

    given = level of ( score + score_noise * deviation * N(0, 1) ), or none at all

Only what others learn from is inexact: the evaluator and the results of episodes have the true
scores. Deviation and the thresholds between levels are those of scores of the random policy,
measured before the run begins, in an environment that is then closed. So they are known from the
first segment on, and are the same for every simulator of the run.

The formulas: docs/methods.md#inexact-scores.
"""

import logging
import math
from dataclasses import dataclass

import numpy as np

from codetr_ros.config import Settings, SettingsError
from codetr_ros.policy.acting import uniform_actions
from codetr_ros.records import F64
from codetr_ros.seeding import generator, seed_global
from codetr_ros.simulation.episode import EpisodeRunner
from codetr_ros.simulation.tasks import make

_log = logging.getLogger(__name__)

MEASURED_SCORES = 100
"""Scores by which the scale is measured, unless they take more steps than the next number."""
MEASURED_STEPS = 20_000
FEWEST_SCORES = 2
"""That many are measured however many steps they take."""


@dataclass(frozen=True, eq=False)
class ScoreScale:
    """The scale of a task's scores, by those of the random policy."""

    deviation: float
    """Standard deviation of the scores; 0 where it is not needed."""
    thresholds: F64
    """(K-1,) ascending: a score above the first k of them is on level k + 1, of K."""

    @classmethod
    def of(cls, settings: Settings) -> 'ScoreScale':
        """Measure the scale, if the settings need it.

        Raises:
            TaskError: the task is unknown or cannot be used.
            SettingsError: noise is in deviations, and all scores are the same.
        """
        if not settings.score_noise and not settings.score_levels:
            return cls(0.0, np.empty(0))
        scores = random_scores(settings)
        levels = settings.score_levels
        shares = np.arange(1, levels) / max(1, levels)
        scale = cls(float(scores.std()), np.quantile(scores, shares))
        if settings.score_noise and not scale.deviation:
            raise SettingsError(
                f'score_noise = {settings.score_noise:g}: {len(scores)} scores of the random '
                f'policy are all {scores[0]:g}, so that their deviation is no unit of noise; set '
                'score_noise=0, or a longer delay'
            )
        if len(np.unique(scale.thresholds)) < len(scale.thresholds):
            _log.warning(
                'score_levels = %s: the thresholds %s are not all different, as scores of the '
                'random policy repeat; some levels are never given',
                levels,
                ', '.join(f'{t:g}' for t in scale.thresholds.tolist()),
            )
        return scale

    def metrics(self) -> dict[str, float]:
        """What was measured, by name; nothing where nothing was."""
        known = {'score_deviation': self.deviation} if self.deviation else {}
        return known | {f'score_threshold_{i}': t for i, t in enumerate(self.thresholds, 1)}


def random_scores(settings: Settings) -> F64:
    """Scores of the random policy, at least two: as many as `MEASURED_SCORES`, or as
    `MEASURED_STEPS` steps give.
    """
    seed = settings.seed
    seed_global(seed, 'environment')  # the same as the simulator's
    environment = make(settings.task)
    scores: list[float] = []
    try:
        seed_global(seed, 'environment', 'scale')
        episode = EpisodeRunner(environment, settings, 'scale')
        number = steps = 0
        while len(scores) < FEWEST_SCORES or (
            len(scores) < MEASURED_SCORES and steps < MEASURED_STEPS
        ):
            episode.reset(int(generator(seed, 'scale', number).integers(2**31)), number)
            rng = generator(seed, 'scale', 'random', number)
            for action in uniform_actions(rng, environment.horizon, environment.action_size):
                _, score = episode.step(action)
                if score is not None:
                    scores.append(score.value)
                if episode.over:
                    break
            number, steps = number + 1, steps + episode.length
    finally:
        environment.close()
    return np.array(scores)


class Scorer:
    """Gives the scores of one source. Its draws depend on seed, source, episode and segment only.

    Args:
        settings: the settings of the run.
        scale: of the task's scores.
        source: whose segments are scored.
    """

    def __init__(self, settings: Settings, scale: ScoreScale, source: str) -> None:
        self._settings = settings
        self._scale = scale
        self._source = source
        self._rng: np.random.Generator | None = None

    @property
    def exact(self) -> bool:
        """Whether scores are given as they are."""
        settings = self._settings
        return not (settings.score_missing or settings.score_noise or settings.score_levels)

    def begin(self, episode: int) -> None:
        """Begin to score an episode."""
        if not self.exact:
            self._rng = generator(self._settings.seed, 'score', self._source, episode)

    def given(self, score: float) -> float:
        """What is given for the next segment's score; NaN: nothing."""
        if self._rng is None:
            return score
        # both are drawn for each segment, so that one setting does not change the other's draws
        luck, noise = self._rng.random(), self._rng.standard_normal()
        if luck < self._settings.score_missing:
            return math.nan
        score += self._settings.score_noise * self._scale.deviation * noise
        if self._settings.score_levels:
            return 1.0 + float(np.searchsorted(self._scale.thresholds, score))
        return score
