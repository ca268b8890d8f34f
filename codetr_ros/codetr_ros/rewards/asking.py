"""Which segments to ask a scorer for first: those whose scores are worth most.

Where the reward method knows how far the level of a score may be off, the segment of which it
knows least comes first, then the one of which it knows least once the first is scored, and so on:
the variance of a level falls by what the chosen ones will reveal of it (greedy selection, as in
Krause and Singh, 2008, for Gaussian processes). So segments that are alike are not asked for
together, and none whose verdict can be foreseen. Elsewhere segments are drawn among the newest.
Only the newest ones are looked at in either case: they are what the present policy does. The
choice of candidates is decided here.
"""

import numpy as np

from codetr_ros.config import Settings
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import F32, F64, I64, ScoreRequest
from codetr_ros.rewards.base import RewardMethod
from codetr_ros.seeding import generator

CANDIDATES = 256
"""The newest segments that nobody has judged, of which some are asked for."""


def worth_asking(
    memory: Trajectories, method: RewardMethod | None, settings: Settings, run_id: str, phase: int
) -> ScoreRequest:
    """The segments that are worth most after a phase, the most valuable first.

    Args:
        memory: holds them.
        method: the reward method, if it has learnt from judgements; None: it has not.
        settings: the run's settings.
        run_id: the run.
        phase: the phase that was learnt from.
    """
    assert memory.judgements is not None, 'the simulator scores: nobody is asked'
    open_ids = np.setdiff1d(memory.segments.all_ids(), memory.judgements.judged())
    candidates = np.sort(memory.segments.newest_first(open_ids)[:CANDIDATES])
    most = min(settings.requests, len(candidates))
    doubt = None
    if method is not None and most:
        doubt = method.doubt(memory.segments.batch(candidates, method.context))
    if doubt is None:
        rng = generator(settings.seed, 'ask', phase)
        chosen = rng.permutation(len(candidates))[:most]
        worths = np.full(most, np.nan, np.float32)
    else:
        chosen, worths = greedy(doubt, most)
    return _request(memory, candidates[chosen], worths, run_id, phase)


def greedy(doubt: F64, most: int) -> tuple[I64, F32]:
    """The places of the most doubtful, each given the answers to those before.

    Args:
        doubt: (C, C) covariance of what is not known, of a rank that may be low.
        most: how many, at the most C.

    Returns:
        Their places (most,), and the standard deviation of each when it was chosen.
    """
    left = doubt.copy()
    noise = 1e-6 * float(np.trace(doubt)) / max(1, len(doubt)) + 1e-12
    chosen: list[int] = []
    worths: list[float] = []
    for _ in range(most):
        variances = left.diagonal().copy()
        variances[chosen] = -1
        at = int(np.argmax(variances))
        chosen.append(at)
        worths.append(float(np.sqrt(max(0.0, variances[at]))))
        left = left - np.outer(left[at], left[at]) / (left[at, at] + noise)
    return np.array(chosen, np.int64), np.array(worths, np.float32)


def _request(memory: Trajectories, ids: I64, worths: F32, run_id: str, phase: int) -> ScoreRequest:
    spans = [memory.segments.spans(ids[i : i + 1])[0] for i in range(len(ids))]
    episodes, firsts, lengths = (
        np.array([int(span[i][0]) for span in spans], np.uint32) for i in (1, 2, 3)
    )
    return ScoreRequest(
        run_id=run_id,
        phase=phase,
        sources=tuple(span[0] for span in spans),
        episodes=episodes,
        first_steps=firsts,
        lengths=lengths,
        worths=worths,
    )
