"""The segments that may be scored: they consist of steps in the store, and are scored once."""

from collections.abc import Callable

from codetr_ros.memory.ring import SourceRing, StoredEpisode
from codetr_ros.memory.store import Store
from codetr_ros.records import CompositeReward, RecordError

Rule = Callable[[CompositeReward, StoredEpisode, int], str | None]
"""Where segments of at most so many steps may lie: returns the fault of one, if it has any."""


def unscored(
    reward: CompositeReward, store: Store, delay: int, rule: Rule
) -> tuple[SourceRing, int]:
    """The ring and the row in which the segment of a composite reward begins.

    Raises:
        RecordError: there is no such segment, or it has its reward already.
    """
    named = (
        f'composite reward {reward.value} of {reward.scorer!r} for {reward.source!r}, episode '
        f'{reward.episode}, first_step {reward.first_step}, length {reward.length}'
    )
    source = store.source(reward.source)
    episode = source.by_number.get(reward.episode) if source else None
    if source is None or episode is None:
        raise RecordError(
            f'{named}: no such episode is here (never sent, or evicted); score segments of '
            'steps sent'
        )
    if fault := rule(reward, episode, delay):
        ended = ' and ended' if episode.ended else ''
        raise RecordError(
            f'{named}: there is no such segment. {fault}; this episode has {episode.steps} '
            f'steps{ended}'
        )
    row = episode.start + reward.first_step
    if source.scored.beginning_at(row) is not None:
        raise RecordError(
            f'{named}: the segment has its composite reward already; the first one is kept'
        )
    if source.scored.meets(row, reward.length, min(delay - 1, reward.first_step)):
        raise RecordError(f'{named}: another score covers some of these steps already; it is kept')
    return source, row


def one_after_another(reward: CompositeReward, episode: StoredEpisode, delay: int) -> str | None:
    """Segments have `delay` steps and follow on each other from an episode's first step on; only
    the last of an ended episode is shorter.
    """
    last = reward.first_step + reward.length
    whole = reward.length == delay
    cut_short = episode.ended and last == episode.steps and 0 < reward.length < delay
    if reward.first_step % delay == 0 and last <= episode.steps and (whole or cut_short):
        return None
    return (
        f'Segments have {delay} steps, start at multiples of {delay} and only the last of an '
        'ended episode is shorter'
    )


def anywhere(reward: CompositeReward, episode: StoredEpisode, delay: int) -> str | None:
    """Segments have 1 to `delay` steps and may lie anywhere in an episode."""
    inside = reward.first_step + reward.length <= episode.steps
    if inside and 0 < reward.length <= delay:
        return None
    return f'Segments have 1 to {delay} steps of those sent'
