"""Cutting the indexed episodes into stretches, each with the scores of its segments."""

from collections import Counter
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from codetr_ros.offline.episodes import Episode, Index, Key, Piece

NO_STEPS = 'scores of steps that are not all there'
OVERLAP = 'scores of steps that another score covers'
TOO_LONG = 'scores of more steps than the delay'


class Segments(NamedTuple):
    """Segments of one stretch, in order of their steps; a value of NaN: without a score."""

    firsts: np.ndarray  # within the episode
    lengths: np.ndarray
    values: np.ndarray


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Stretch:
    """Part of an episode with its segments; held out or learnt from as a whole."""

    key: Key
    episode: int
    first: int  # within the episode
    steps: int
    segments: Segments


@dataclass
class Stretches:
    """The stretches to learn from, and the counts of the rest."""

    usable: list[Stretch]
    skipped: Counter[str]
    unscored: int  # steps that no score covers
    declared: int = 0  # of these, steps of segments that state that they have no score


def stretches(index: Index, delay: int, longest: int, unscored: bool = False) -> Stretches:
    """Cut the indexed episodes into stretches with scores.

    Args:
        index: of the bags.
        delay: scores of more steps are left out.
        longest: a longer piece is cut, between two segments, into stretches of about this many
            steps.
        unscored: whether stretches of segments without a score are usable too.
    """
    made = Stretches([], Counter(index.skipped), index.steps)
    for episode in index.episodes.values():
        segments = _sound_segments(episode, delay, made.skipped)
        scored = ~np.isnan(segments.values)
        made.unscored -= int(segments.lengths[scored].sum())
        made.declared += int(segments.lengths[~scored].sum())
        for piece in episode.pieces:
            inside = (segments.firsts >= piece.first) & (
                segments.firsts + segments.lengths <= piece.end
            )
            mine = Segments(*(part[inside] for part in segments))
            cut = _cut(episode, piece, mine, longest)
            made.usable += [s for s in cut if unscored or not np.isnan(s.segments.values).all()]
    return made


def _sound_segments(episode: Episode, delay: int, skipped: 'Counter[str]') -> Segments:
    """The scores of an episode whose steps are all there, without overlaps."""
    order = np.argsort(np.asarray(episode.firsts, np.int64), kind='stable')
    firsts = np.asarray(episode.firsts, np.int64)[order]
    lengths = np.asarray(episode.lengths, np.int64)[order]
    values = np.asarray(episode.values, np.float64)[order]
    there = np.zeros(len(firsts), bool)
    for piece in episode.pieces:
        there |= (firsts >= piece.first) & (firsts + lengths <= piece.end) & (lengths > 0)
    short = lengths <= delay
    keep = there & short
    skipped[NO_STEPS] += int((~there).sum())
    skipped[TOO_LONG] += int((there & ~short).sum())
    end = -1
    for i in np.flatnonzero(keep).tolist():
        if firsts[i] < end:
            keep[i] = False
            skipped[OVERLAP] += 1
        else:
            end = int(firsts[i] + lengths[i])
    return Segments(firsts[keep], lengths[keep], values[keep])


def _cut(episode: Episode, piece: Piece, segments: Segments, longest: int) -> list[Stretch]:
    cut = []
    begin, at = piece.first, 0
    ends = segments.firsts + segments.lengths
    while at < len(ends):
        upto = max(at + 1, int(np.searchsorted(ends, begin + longest, side='right')))
        last = upto == len(ends)
        end = int(ends[upto - 1]) if not last or piece.end - begin > longest else piece.end
        mine = Segments(*(part[at:upto] for part in segments))
        cut.append(
            Stretch(
                key=episode.key,
                episode=episode.number,
                first=begin,
                steps=end - begin,
                segments=mine,
            )
        )
        begin, at = end, upto
    return cut
