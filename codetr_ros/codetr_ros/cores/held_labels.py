"""Labels that a learner holds until the phase that they were made of is learnt from."""

from collections.abc import Collection

from codetr_ros.records import RecordError, StepRewards, describe
from codetr_ros.records.digests import raw_digest

MOST_CLAIMS = 4
"""Commits of one phase that labels may claim to be made of, at a time."""


class HeldLabels:
    """Labels by the phase, and by the commit that they were made of.

    The labels of a phase can arrive before its commit, which travels on another topic. But nobody
    can know the digest of a commit that is still to come: labels that were made up before it claim
    another, and go once the commit is known.
    """

    def __init__(self) -> None:
        self.dropped = 0
        """Parts that went because more than `MOST_CLAIMS` commits of a phase were claimed."""
        self._held: dict[int, dict[str, dict[int, StepRewards]]] = {}

    def add(self, part: StepRewards, commits: Collection[str] = ()) -> bool:
        """Hold one part; returns whether it is new.

        Args:
            part: the labels.
            commits: digests of the commits of the phase that have come. Of a flood of claims,
                those of other commits go first.

        Raises:
            RecordError: it contradicts those that are held; nothing has changed then.
        """
        claims = self._held.get(part.phase, {})
        parts = claims.get(part.commit, {})
        others = next((one.parts for one in parts.values()), part.parts)
        if part.part >= part.parts or part.parts != others:
            raise RecordError(
                f'{describe(part)}: part {part.part} of {part.parts}, where others of the '
                f'phase are of {others}: two reward nodes? Stop one of them'
            )
        known = parts.get(part.part)
        if known is not None:
            if raw_digest(known) != raw_digest(part):
                raise RecordError(
                    f'{describe(part)} contradicts the same part that has come before: two '
                    'reward nodes? Stop one of them'
                )
            return False
        if part.commit not in claims and len(claims) == MOST_CLAIMS:
            gone = next((claim for claim in claims if claim not in commits), next(iter(claims)))
            self.dropped += len(claims.pop(gone))
        self._held.setdefault(part.phase, {}).setdefault(part.commit, {})[part.part] = part
        return True

    def whole(self, phase: int, commit: str) -> bool:
        """Whether all labels of a phase are there that were made of this commit."""
        parts = self._held.get(phase, {}).get(commit, {})
        return bool(parts) and len(parts) == next(iter(parts.values())).parts

    def take(self, phase: int, commit: str) -> tuple[list[StepRewards], int]:
        """The labels of a phase in order, and how many go that claim to be of another commit."""
        claims = self._held.pop(phase)
        parts = claims.pop(commit)
        return [part for _, part in sorted(parts.items())], sum(map(len, claims.values()))

    def forget(self, phase: int) -> None:
        """Drop the labels up to a phase."""
        for early in [early for early in self._held if early <= phase]:
            del self._held[early]
