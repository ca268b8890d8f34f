"""The memory D: whole trajectories, their scored segments and their step rewards.

Both the reward side and the learner keep one. Each observation is stored once; a step costs
`Trajectories.bytes_per_step` bytes. Records are checked against the content: a wrong one is
refused and changes nothing.
"""

from codetr_ros.config.cuts import Cuts
from codetr_ros.memory.judgements import Judgements, Predict
from codetr_ros.memory.labelled import LabelledSteps
from codetr_ros.memory.segments import Segments
from codetr_ros.memory.store import Store
from codetr_ros.records import (
    CompositeReward,
    Preference,
    RecordError,
    StepRewards,
    Transitions,
    TrueRewards,
)
from codetr_ros.records.numbering import Judgement

FIRST_JUDGEMENTS = 4
"""Scores and preferences from which learning begins, where others than the simulator score."""


class Trajectories:
    """Everything simulated, scored and labelled, bounded by a number of steps.

    The methods here change the memory. Its three parts give its content: `store` has the steps,
    `segments` the spans of steps that have a composite reward, and `labelled` the steps that have
    a step reward.

    Args:
        observation_size: O.
        action_size: A.
        delay: steps n of a segment.
        capacity: steps, of all sources together, after which `evict` drops the oldest episodes.
            Each source has rows for as many, which take memory when they are first used.
        margin: steps that may be held beyond the capacity before `evict` is called: a phase and an
            episode.
        true_rewards: keep the environment's own rewards too, for the oracle.
        regular: segments have `delay` steps and follow on each other from an episode's first step
            on, only its last is shorter. Else they may lie anywhere and have 1 to `delay` steps,
            as long as no two share a step.
        progress: keep how far each labelled step's segment had come, for critics that see it.
        cuts: where episodes are cut into segments, if others than the simulator score them:
            then every segment is here once its steps are, with or without a score.
    """

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        delay: int,
        capacity: int,
        margin: int,
        true_rewards: bool = False,
        regular: bool = True,
        progress: bool = False,
        cuts: Cuts | None = None,
    ) -> None:
        self.observation_size = observation_size
        self.action_size = action_size
        self.delay = delay
        self.evicted = 0
        self.store = Store(
            observation_size, action_size, capacity, capacity + margin, true_rewards, progress
        )
        self.segments = Segments(self.store, delay, regular)
        self.labelled = LabelledSteps(self.store, delay)
        self._cuts = cuts
        self.judgements = None if cuts is None else Judgements(self.segments)

    def append(self, chunk: Transitions) -> None:
        """Add consecutive steps that go on where their source's last ones ended.

        Raises:
            RecordError: they do not follow on what is here, or there is no room for them.
        """
        self.store.append(chunk)
        if self._cuts is not None:
            self.segments.add_unscored(chunk, self._cuts)
        self._forget()

    def append_true_rewards(self, record: TrueRewards) -> None:
        """Add the environment's own rewards of steps that are here: for the oracle, never in a
        node.
        """
        self.store.append_true_rewards(record)

    def score(self, reward: CompositeReward) -> None:
        """Add a segment whose steps are here, with its composite reward: NaN if it has none.

        Raises:
            RecordError: there is no such segment, or it has its reward already.
        """
        self.segments.score(reward)

    def judge(self, judgement: Judgement) -> None:
        """Take what a scorer states: its score of a segment, or which of two is better.

        Where others than the simulator score, it counts from the next `settle` on.

        Raises:
            RecordError: there is no such segment, or none that may have another score.
        """
        if self.judgements is not None:
            self.judgements.take(judgement)
        elif isinstance(judgement, Preference):
            raise RecordError(
                f'{judgement.scorer!r} compares segments in a run whose simulator scores them'
            )
        else:
            self.score(judgement)

    def awaited(self, judgement: Judgement) -> bool:
        """Whether some steps of what others than the simulator judge are still to come."""
        if self.judgements is None:
            return False
        ends = [(judgement.source, judgement.episode, judgement.first_step + judgement.length)]
        if isinstance(judgement, Preference):
            end = judgement.other_first_step + judgement.other_length
            ends.append((judgement.other_source, judgement.other_episode, end))
        return any(self.store.awaits(*end) for end in ends)

    def settle(self, predict: Predict | None = None) -> None:
        """Give each segment one score, from those of all its scorers.

        Args:
            predict: what the reward model expects of segments; None: it knows nothing yet.
        """
        if self.judgements is not None:
            self.judgements.settle(predict)

    def informed(self, preferences: bool) -> bool:
        """Whether there is enough to begin to learn from: a score, or some judgements where
        others than the simulator score, since what is measured first is frozen.

        Args:
            preferences: whether these count.
        """
        scores = len(self.segments.ids())
        if self.judgements is None:
            return scores > 0
        pairs = len(self.judgements.pairs()) if preferences else 0
        return scores + pairs >= FIRST_JUDGEMENTS

    def apply(self, rewards: StepRewards) -> int:
        """Store labels, and return how many were left out because their episodes were evicted.

        Raises:
            RecordError: a label is for steps that are not here; nothing is stored then.
        """
        return self.labelled.apply(rewards)

    def evict(self) -> int:
        """Drop whole episodes, oldest first, until at most `capacity` steps are held, and return
        the number of steps dropped.

        The last episode of all is kept however long it is: an empty memory teaches nothing.
        """
        dropped = self.store.evict()
        self.evicted += dropped
        if dropped and self.judgements is not None:
            self.judgements.forget_evicted()
        self._forget()
        return dropped

    def _forget(self) -> None:
        """Make the parts work out anew what depends on the steps held."""
        self.segments.forget()
        self.labelled.forget()

    @property
    def steps(self) -> int:
        """Steps held."""
        return self.store.steps

    @property
    def bytes_per_step(self) -> int:
        """Bytes that one stored step takes: observation, action, label, its model version, two
        flags.
        """
        return self.store.bytes_per_step

    @property
    def nbytes(self) -> int:
        """Bytes of the rows in use, with each episode's final observation and the table of
        segments.
        """
        return self.store.nbytes + self.segments.nbytes

    def report(self) -> dict[str, int]:
        """Steps held and memory taken, for a run's summary."""
        return {
            'steps': self.steps,
            'evicted': self.evicted,
            'bytes_per_step': self.bytes_per_step,
            'bytes': self.nbytes,
        }
