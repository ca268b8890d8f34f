"""Cores of a run, driven by hand: phases handed in, slices of work taken."""

from dataclasses import replace

import numpy as np

from codetr_ros.records import CompositeReward
from codetr_ros.records.chain import Chain
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
        self.chain = Chain(settings.lag)
        self.commits = []  # digests of the commits so far, of which labels are made

    def phase(self, core, phase, scored=True):
        steps, delay = self.settings.phase_steps, self.settings.delay
        first, end = phase * steps // delay, (phase + 1) * steps // delay
        chunk = transitions(
            sequence=phase,
            phase=phase,
            first_step=phase * steps,
            steps=steps,
            phase_end=True,
            scores_due=end - first if scored else 0,
        )
        if self.last is not None:
            chunk.observations[0] = self.last.observations[-1]
        self.last = chunk
        core.receive(chunk)
        self.chain.note(chunk)
        for n in range(first, end) if scored else ():
            reward = score(sequence=n, first_step=n * delay, length=delay, value=float(n))
            self.chain.note(reward)
            if CompositeReward in core.subscribes:
                core.receive(reward)
        number = np.array([phase], np.int64)
        last = np.array([end - 1 if scored else -1], np.int64)
        made = self.chain.completed(commit(phase=phase, transitions=number, scores=last))
        before = self.settings.labels_named(phase)
        made = replace(  # the recorder has what the core itself has published
            made,
            policy_digest=core._intake.policies.get(phase, ''),
            labels_digest=core._intake.labels.get(before, ''),
        )
        self.chain.follow(made)
        self.commits.append(self.chain.last)
        core.receive(made)
