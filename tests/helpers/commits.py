"""Phases of five steps, and commits that have the digests of their records."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from codetr_ros.records import Commit, CompositeReward, Record, Transitions
from codetr_ros.records.chain import Chain
from helpers.builders import commit, transitions

STEPS = {'steps': 15, 'phase_steps': 5, 'warmup_steps': 5}
"""Settings with phases of the five steps that `transitions` has."""


def chunk(number: int = 0, **changes) -> Transitions:
    """The steps of a phase, which follow on those of the phase before."""
    last = transitions()
    observations = last.observations.copy()
    if number:
        observations[0] = last.observations[-1]
    fields = {'sequence': number, 'phase': number, 'first_step': 5 * number, 'phase_end': True}
    return transitions(**({'observations': observations} | fields | changes))


def committed(*records: Record, before: Sequence[Commit] = (), **changes) -> Commit:
    """The commit of a phase that has these records, behind others."""
    chain = Chain(1)
    for commit_ in before:
        chain.follow(commit_)
    for record in records:
        chain.note(record)
    steps = [r for r in records if isinstance(r, Transitions)]
    scores = [r for r in records if isinstance(r, CompositeReward)]
    sources = sorted({r.source for r in steps})
    fields = {
        'phase': len(before),
        'sources': tuple(sources),
        'transitions': np.array(
            [max(r.sequence for r in steps if r.source == s) for s in sources]
        ),
        'scorers': tuple(sorted({r.scorer for r in scores})),
        'scores': np.array([max(r.sequence for r in scores)] if scores else [], np.int64),
    }
    made = chain.completed(commit(**(fields | {'phase': changes.get('phase', len(before))})))
    return replace(made, **changes)
