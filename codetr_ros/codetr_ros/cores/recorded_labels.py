"""The labels that commits name: which they are, and what the bag keeps of them."""

from codetr_ros.bags.first_labels import FirstLabels
from codetr_ros.config import Settings
from codetr_ros.records import RecordError, StepRewards, describe
from codetr_ros.records.chain import Chain
from codetr_ros.records.digests import raw_digest


class RecordedLabels:
    """The labels that a recorder takes, made of its commits, until a commit names them.

    Args:
        settings: of the run.
        chain: notes them.
    """

    def __init__(self, settings: Settings, chain: Chain) -> None:
        self._ahead = settings.ahead
        self._chain = chain
        self._commits: dict[int, str] = {}  # phase -> digest of the commit that labels are made of
        self._parts: dict[int, int] = {}  # phase -> how many
        self._digests: dict[tuple[int, int], bytes] = {}  # (phase, part) ->
        self._first = FirstLabels(settings) if settings.record_relabels == 'first' else None
        self._restored: dict[tuple[int, int], StepRewards] = {}  # what a bag has of them
        self._last: tuple[StepRewards, StepRewards] | None = None  # taken, and what is kept of it
        self._lacks: dict[int, set[int]] = {}  # parts that are still to come, by phase
        self.due = settings.first_labelled
        """The first phase whose labels are not all there."""

    @property
    def next(self) -> tuple[int, int]:
        """Phase and part of the labels that come next."""
        return self.due, min(self._lacks.get(self.due, ()), default=0)

    @property
    def reduced(self) -> bool:
        """Whether the bag has less than was published."""
        return self._first is not None

    def take(self, part: StepRewards, next_phase: int) -> bool:
        """Note labels; returns whether they are new.

        Args:
            part: the labels.
            next_phase: the next to be committed.

        Raises:
            RecordError: they are of a phase that is not committed, were made of another commit, or
                contradict those that have come already.
        """
        if part.phase >= next_phase:
            raise RecordError(
                f'{describe(part)} has labels of phase {part.phase}, but phase {next_phase} is '
                'the next to be committed: stop what publishes them'
            )
        made_of = self._commits.get(part.phase)
        if made_of is None:
            return False  # a commit has named them
        if part.commit != made_of:
            raise RecordError(
                f'{describe(part)} was made of the commit {part.commit!r}; that of phase '
                f'{part.phase} is {made_of!r}: stop the second reward node, or install the same '
                'version of codetr_ros everywhere'
            )
        parts = self._parts.setdefault(part.phase, part.parts)
        digest = raw_digest(part)
        known = self._digests.get((part.phase, part.part), digest)
        if part.parts != parts or part.part >= parts or known != digest:
            raise RecordError(
                f'{describe(part)} contradicts the labels of phase {part.phase} that have come '
                f'already, of {parts} parts: stop the second reward node'
            )
        if (part.phase, part.part) in self._digests:
            return False
        self._digests[part.phase, part.part] = digest
        self._arrived(part)
        kept = self._restored.pop((part.phase, part.part), None)
        if kept is None and self._first is not None:
            kept = self._first.keep(part)
        self._last = None if kept is None else (part, kept)
        self._chain.note(part, kept)
        return True

    def _arrived(self, part: StepRewards) -> None:
        if part.phase < self.due:
            return
        self._lacks.setdefault(part.phase, set(range(part.parts))).discard(part.part)
        while self._lacks.get(self.due) == set():
            del self._lacks[self.due]
            self.due += 1

    def kept(self, part: StepRewards) -> StepRewards:
        """What the bag keeps of labels that have just been taken."""
        return self._last[1] if self._last is not None and self._last[0] is part else part

    def restore(self, part: StepRewards) -> None:
        """Note that a bag has labels, reduced to what it keeps: whole, they must come again."""
        if self._first is not None:
            self._first.keep(part)
        self._restored[part.phase, part.part] = part
        self._arrived(part)

    def follow(self, phase: int) -> None:
        """Go on behind the commit of a phase, the last that the chain has followed."""
        self._commits[phase] = self._chain.last
        for named in [named for named in self._commits if named <= phase - self._ahead]:
            del self._commits[named]
            self._parts.pop(named, None)
        for key in [key for key in self._digests if key[0] not in self._parts]:
            del self._digests[key]
        for key in [key for key in self._restored if key[0] <= phase - self._ahead]:
            del self._restored[key]
