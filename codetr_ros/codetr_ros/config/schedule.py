"""Phases, shares, sources and evaluations that follow from the settings of a run."""

from typing import TYPE_CHECKING

from codetr_ros.records import roles

ROBOT = 'robot/'
"""What the name of a task begins with that is no simulation but somebody's robot."""

FREE_AHEAD = 8
"""Phases by which a robot at a free pace may be ahead of what has been learnt from."""


class Schedule:
    """The arithmetic of a run, mixed into its settings."""

    if TYPE_CHECKING:  # fields of `Settings`; with annotations at run time they would come first
        task: str
        pace: str
        steps: int
        phase_steps: int
        warmup_steps: int
        overlap: bool
        simulators: int
        joiners: tuple[str, ...]
        envs: int
        evaluate_every: int

        @property
        def scorer(self) -> str:
            """Who scores segments."""

        @property
        def labels_steps(self) -> bool:
            """Whether a reward method labels steps."""

    @property
    def phases(self) -> int:
        """Phases of the run; the last may be shorter."""
        return -(-self.steps // self.phase_steps)

    @property
    def warmup_phases(self) -> int:
        """Phases under the random policy, which ends the last of them too."""
        return min(self.phases, -(-self.warmup_steps // self.phase_steps))

    @property
    def lag(self) -> int:
        """Phases between learning a policy and acting under it: 1 in lock-step, 2 with overlap."""
        return 2 if self.overlap else 1

    @property
    def free(self) -> bool:
        """Whether the source waits for no permission."""
        return self.pace == 'free'

    @property
    def on_robot(self) -> bool:
        """Whether the steps are those of a robot, not of a simulation."""
        return self.task.startswith(ROBOT)

    @property
    def ahead(self) -> int:
        """Phases by which a source may be ahead of the newest that was learnt from."""
        return FREE_AHEAD if self.free else self.lag

    @property
    def first_labelled(self) -> int:
        """The first phase whose steps are labelled: the last of the warm-up. Each one since is."""
        return max(0, self.warmup_phases - 1)

    def labels_named(self, phase: int) -> int | None:
        """The phase whose labels the commit of a phase names: those that the learner had learnt
        from when it permitted the phase. None where there are none: in the warm-up, where nobody
        labels steps, and at a free pace, where nothing is permitted.
        """
        before = phase - self.lag
        return (
            before
            if before >= self.first_labelled and self.labels_steps and not self.free
            else None
        )

    def steps_of(self, phase: int) -> int:
        """Environment steps of a phase, all sources together; 0 beyond the last."""
        return max(0, min(self.phase_steps, self.steps - phase * self.phase_steps))

    def shares_of(self, phase: int) -> list[int]:
        """Steps of a phase for each source. If they do not divide evenly, the first sources take
        one more.
        """
        share, rest = divmod(self.steps_of(phase), self.source_count)
        return [share + (i < rest) for i in range(self.source_count)]

    def steps_after(self, version: int) -> int:
        """Environment steps that policy version `version` has learnt from."""
        return min(self.steps, (version + 1) * self.phase_steps)

    def evaluated(self, version: int) -> bool:
        """Whether this policy version is evaluated: the last one is, and the first past each
        multiple of `evaluate_every`.

        Policies of the warm-up act at random and are not evaluated: the random policy is, once, at
        step 0.
        """
        if self.evaluate_every == 0 or version < self.warmup_phases - 1:
            return False
        if version == self.phases - 1:
            return True
        return (
            self.steps_after(version) // self.evaluate_every
            > self.steps_after(version - 1) // self.evaluate_every
        )

    @property
    def simulator_names(self) -> tuple[str, ...]:
        """Names that `codetr train` gives the run's simulators: sim, sim_2, sim_3, ..."""
        return ('sim', *(f'sim_{i}' for i in range(2, self.simulators + 1)))

    @property
    def source_count(self) -> int:
        """Number of sources of the run: the environments of all simulators."""
        return (self.simulators + len(self.joiners)) * self.envs

    @property
    def joining_sources(self) -> frozenset[str]:
        """The sources of simulators that need not be there at the start."""
        return frozenset(source for name in self.joiners for source in self.sources_of(name))

    @property
    def alone(self) -> bool:
        """Whether a single simulator takes all steps: nothing goes on without it."""
        return self.simulators + len(self.joiners) == 1

    def sources_of(self, simulator: str) -> tuple[str, ...]:
        """Names of a simulator's sources: its own name for one environment; sim-1, sim-2, ... for
        several.
        """
        if self.envs == 1:
            return (simulator,)
        return tuple(f'{simulator}-{i}' for i in range(1, self.envs + 1))

    def simulator_of(self, source: str) -> str:
        """The simulator of a source. No name of a node has a hyphen."""
        return source if self.envs == 1 else source.rpartition('-')[0]

    @property
    def roles(self) -> dict[str, int]:
        """Number of nodes that the run needs of each role."""
        return roles.needed(self)
