"""Cores of a run, driven by hand: phases handed in, slices of work taken."""

import numpy as np

from codetr_ros.records import (
    CompositeReward,
)
from helpers.builders import commit, score, transitions


def slices(work, most=10_000):
    """All that a core yields until it has nothing to do."""
    found = []
    for _ in range(most):
        out = next(work)
        if out is None:
            return found
        found += out
    raise AssertionError('never idle')


class Endless:
    """One endless episode, handed to a core phase by phase, with its scores and commits."""

    def __init__(self, settings):
        self.settings = settings
        self.last = None

    def phase(self, core, phase, scored=True):
        steps, delay = self.settings.phase_steps, self.settings.delay
        chunk = transitions(sequence=phase, phase=phase, first_step=phase * steps, steps=steps)
        if self.last is not None:
            chunk.observations[0] = self.last.observations[-1]
        self.last = chunk
        core.receive(chunk)
        end = (phase + 1) * steps // delay
        if scored and CompositeReward in core.subscribes:
            for n in range(phase * steps // delay, end):
                core.receive(score(sequence=n, first_step=n * delay, length=delay, value=float(n)))
        number = np.array([phase], np.int64)
        last = np.array([end - 1 if scored else -1], np.int64)
        core.receive(commit(phase=phase, transitions=number, scores=last))
