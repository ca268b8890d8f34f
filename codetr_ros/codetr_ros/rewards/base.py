"""The base of reward methods, which turn the scores of segments into a reward for every step."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from codetr_ros.config import Settings
from codetr_ros.memory.batches import SegmentBatch
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import F32, F64
from codetr_ros.runs.reports import PREFERENCES_UNUSED
from codetr_ros.system.states import check_state

ModelFacts = dict[str, str | float | list[float]]
"""What a method states of itself in a run's summary, by name."""


class RewardModelError(ValueError):
    """A reward model that cannot be used, trained or restored: names value, field and remedy."""


@dataclass(frozen=True)
class Schedule:
    """Gradient steps that a method takes in each phase that it learns from."""

    first: int
    """After the last phase of the warm-up."""
    each: int
    """After every later phase."""


class RewardMethod(ABC):
    """One way of making step rewards. Algorithm 1 knows reward methods by this class only.

    In each phase that is learnt from it calls `prepare`, then `gradient_step` as often as
    `schedule` states, then `label_passes` for the new segments. Once `version` has risen, it also
    labels all the others again, or those with the oldest labels (`relabel_steps`), or those that
    will be drawn (`relabel`).

    Labels are in the unit of `settings.reward_unit`: in units of the target scale c (`scaled`), or
    as the task gives them (`raw`).

    Args:
        settings: the run's settings.
        observation_size: O.
        action_size: A.
    """

    name: ClassVar[str]
    in_process_only: ClassVar[bool] = False
    """Whether it is a reference for runs in process only: it sees what no node may see, or ignores
    scores.
    """
    needs_true_rewards: ClassVar[bool] = False
    """Whether its memory must hold the environment's own rewards."""
    uses_preferences: ClassVar[bool] = False
    """Whether it learns from which of two segments is better, too."""
    context: int = 0
    """Steps before a segment that `label` needs in its batches: pass it to `Segments.batch`."""
    label_batch: int = 256
    """Segments labelled at a time: how long a slice of labelling is."""

    def __init__(self, settings: Settings, observation_size: int, action_size: int) -> None:
        self._settings = settings
        self.target_scale = 0.0
        """The unit c of composite rewards per step; 0 before `prepare`."""
        self.gradient_steps = 0
        """Gradient steps taken."""

    @property
    def schedule(self) -> Schedule:
        """Gradient steps of a phase; none unless a method overrides this."""
        return Schedule(0, 0)

    @property
    def version(self) -> int:
        """A number that rises whenever labels given before may have changed."""
        return self.gradient_steps

    @property
    def unit(self) -> float:
        """The factor by which labels are multiplied to be in the task's unit."""
        return self.target_scale if self._settings.reward_unit == 'scaled' else 1.0

    def set_aside(self, memory: Trajectories) -> dict[str, int]:
        """How many judgements are not learnt from as they were stated, by the reason in words."""
        pairs = 0 if memory.judgements is None else len(memory.judgements.pairs())
        return {PREFERENCES_UNUSED: pairs} if pairs and not self.uses_preferences else {}

    def prepare(self, memory: Trajectories) -> None:
        """Look at the memory before a phase's gradient steps and labels.

        The first call freezes what never changes afterwards, such as the target scale c. `memory`
        holds a scored segment.
        """
        if not self.target_scale:
            self.target_scale = memory.segments.target_scale(self._settings.target_scale)

    def gradient_step(self, memory: Trajectories, rng: np.random.Generator) -> dict[str, float]:
        """Learn from one batch, drawn from `memory` with `rng`; by default there is nothing to do.

        Dropout draws from torch's global generator, which the caller seeds.

        Returns:
            Metrics of the step, by name.

        Raises:
            RewardModelError: not prepared, or training has diverged; nothing has changed then.
        """
        return {}

    @abstractmethod
    def label(self, batch: SegmentBatch) -> F32:
        """Step rewards (B, L) of segments, in the places of the batch's steps.

        Outside of `segment_steps(batch)`, in context and padding, they are 0.

        Raises:
            RewardModelError: `prepare` was never called.
        """

    def label_passes(self, memory: Trajectories, ids: NDArray[np.int64]) -> Iterator[F32]:
        """Labels of the segments' steps in order, forward pass by forward pass.

        Segments may have no score; at least one of the memory has.
        """
        batch = self._completed(memory, memory.segments.batch(ids, self.context))
        yield self.label(batch)[segment_steps(batch)]

    def _completed(self, memory: Trajectories, batch: SegmentBatch) -> SegmentBatch:
        """The batch with something in the place of scores that are missing, if labels need it."""
        return batch

    @property
    def single_steps(self) -> bool:
        """Whether `step_passes` labels some steps of a segment at less cost than all of them."""
        return False

    def step_passes(
        self, memory: Trajectories, ids: NDArray[np.int64], within: NDArray[np.int64]
    ) -> Iterator[F32]:
        """Labels of single steps, if `single_steps` is true, forward pass by forward pass.

        Args:
            memory: holds the steps.
            ids: each step's segment.
            within: its number within the segment.
        """
        raise NotImplementedError(f'method {self.name!r} labels whole segments')

    def step_deviations(self, batch: SegmentBatch) -> F32 | None:
        """How far each label (B, L) may be off, one standard deviation; None if not known."""
        return None

    def doubt(self, batch: SegmentBatch) -> F64 | None:
        """Covariance (B, B) of how far the levels of segments' scores may be off, in the squared
        unit of labels, as far as scores of others can tell; None if not known.
        """
        return None

    def step_weights(self, batch: SegmentBatch) -> F32 | None:
        """Weights w (B, L) of the steps in the score; None if the method has none."""
        return None

    def metrics(self) -> dict[str, float]:
        """What there is to publish about the method after a phase, by name; nothing unless a
        method has something.
        """
        return {}

    def report(self) -> ModelFacts:
        """What a run's summary has of the method, by name; nothing unless it has something."""
        return {}

    def state(self) -> dict[str, torch.Tensor]:
        """Copies of everything needed to go on from here."""
        return {'target_scale': torch.tensor(self.target_scale, dtype=torch.float64)}

    def load_state(self, state: Mapping[str, torch.Tensor]) -> None:
        """Go on from a `state()`.

        Raises:
            RewardModelError: it is another method's or architecture's; nothing has changed then.
        """
        check_state(f'reward method {self.name!r}', self.state(), state, RewardModelError)
        self.target_scale = float(state['target_scale'])

    def _require_prepared(self) -> None:
        if not self.target_scale:
            raise RewardModelError(
                f'method {self.name!r} has no target scale yet: '
                'call prepare(memory) before it is trained or used'
            )


class Predictor(RewardMethod):
    """A reward method that predicts scores from steps alone, so that it can be judged by them."""

    @abstractmethod
    def predict(self, batch: SegmentBatch) -> F64:
        """The predicted composite rewards (B,), in the task's unit."""


def segment_steps(batch: SegmentBatch) -> NDArray[np.bool_]:
    """Which steps (B, L) of a batch are its segments' own: neither context nor padding."""
    step = np.arange(batch.actions.shape[1])
    inside: NDArray[np.bool_] = (step >= batch.context[:, None]) & (step < batch.lengths[:, None])
    return inside
