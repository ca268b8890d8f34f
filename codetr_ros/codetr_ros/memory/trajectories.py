"""The memory D: whole trajectories, their scored segments and their step rewards.

Both the reward side and the learner keep one. Each observation is stored once; a step costs
`Trajectories.bytes_per_step` bytes. Records are checked against the content: a wrong one is
refused and changes nothing.
"""

from codetr_ros.memory.labelled import LabelledSteps
from codetr_ros.memory.segments import Segments
from codetr_ros.memory.store import Store
from codetr_ros.records import CompositeReward, StepRewards, Transitions, TrueRewards


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

    def append(self, chunk: Transitions) -> None:
        """Add consecutive steps that go on where their source's last ones ended.

        Raises:
            RecordError: they do not follow on what is here, or there is no room for them.
        """
        self.store.append(chunk)
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
