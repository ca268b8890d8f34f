"""The commits of a recorded run, as they are played to nodes that learn from it again.

What is played is compared with the digests that were recorded. The nodes compare it once more,
with the commit that they receive. Where a live learner permits, or a live reward node labels, that
commit names their policies and labels; and where the run is another one, its id.
"""

from collections.abc import Collection
from dataclasses import replace

from codetr_ros.config import Settings
from codetr_ros.records import Commit, Policy, Record, StepRewards
from codetr_ros.records.chain import Chain

_MADE_BY = {Policy: 'learner', StepRewards: 'reward'}


class PlayedCommits:
    """Completes the commits that are played.

    Args:
        run_id: of the run that is played to.
        settings: of that run.
        lag: of the recorded run; None: its commits name no labels.
        live: roles whose real nodes take part.
    """

    def __init__(
        self, run_id: str, settings: Settings, lag: int | None, live: Collection[str]
    ) -> None:
        self._run_id = run_id
        self._settings = settings
        self._live = live
        self._recorded = Chain(lag)
        self._played = Chain(None if settings.free else settings.lag)
        self._digests: dict[int, str] = {}  # of the last commits that were played

    @property
    def subscribes(self) -> tuple[type, ...]:
        """The kinds of records that live nodes make, and that commits name."""
        return tuple(kind for kind, role in _MADE_BY.items() if role in self._live)

    def note(self, record: Record, recorded: bool) -> None:
        """Note a record that goes out.

        Args:
            record: the record.
            recorded: whether it is from the bag, not from a live node.
        """
        if recorded:
            self._recorded.note(record)
        if recorded != (_MADE_BY.get(type(record)) in self._live):
            self._played.note(record)

    def lacks(self, commit: Commit) -> str:
        """What a live node has yet to publish for a commit, in words; empty if nothing."""
        phase, before = commit.phase, self._settings.labels_named(commit.phase)
        if 'learner' in self._live and not self._settings.free and not self._played.policy(phase):
            return f'the permission for phase {phase} from the learner'
        if 'reward' in self._live and before is not None and not self._played.labels(before)[0]:
            return f'labels of phase {before} from the reward node'
        return ''

    def completed(self, commit: Commit) -> tuple[Commit, list[str]]:
        """The commit to be played; and what of the recorded one differs from its records, in
        words.
        """
        differing = list(self._recorded.differences(commit))
        self._recorded.follow(commit)
        played = self._played.completed(replace(commit, run_id=self._run_id))
        self._played.follow(played)
        self._digests[played.phase] = self._played.last
        for phase in [p for p in self._digests if p < played.phase - self._settings.ahead]:
            del self._digests[phase]
        return played, differing

    def labelled(self, part: StepRewards) -> StepRewards:
        """Recorded labels, as made of the commit that is played."""
        commit = self._digests.get(part.phase, part.commit)
        return part if commit == part.commit else replace(part, commit=commit)
