"""Memories D filled by hand, and one that is plain and slow."""

import numpy as np

from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import CompositeReward, StepRewards, Transitions

OBSERVATION, ACTION, DELAY = 3, 2, 4


class Naive:
    """Episodes of one or more sources as plain lists: what the memory should be equal to."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.episodes: dict[tuple[str, int], dict] = {}
        self.sequence: dict[str, int] = {}
        self.current: dict[str, int] = {}

    def chunk(
        self, source: str, steps: int, end: str | None = None, phase: int = 0
    ) -> Transitions:
        number = self.current.setdefault(source, 0)
        key = (source, number)
        if key not in self.episodes:
            first = self.rng.normal(size=OBSERVATION).astype(np.float32)
            self.episodes[key] = {
                'observations': [first],
                'actions': [],
                'terminated': False,
                'ended': False,
            }
        episode = self.episodes[key]
        first_step = len(episode['actions'])
        for _ in range(steps):
            episode['observations'].append(self.rng.normal(size=OBSERVATION).astype(np.float32))
            episode['actions'].append(self.rng.uniform(-1, 1, ACTION).astype(np.float32))
        if end:
            episode['ended'], episode['terminated'] = True, end == 'terminated'
            self.current[source] = number + 1
        sequence = self.sequence.get(source, 0)
        self.sequence[source] = sequence + 1
        return Transitions(
            run_id='run',
            source=source,
            sequence=sequence,
            phase=phase,
            episode=number,
            first_step=first_step,
            steps=steps,
            observations=np.array(episode['observations'][first_step:]),
            actions=np.array(episode['actions'][first_step:]),
            terminated=end == 'terminated',
            truncated=end == 'truncated',
            phase_end=False,
            scores_due=0,
        )


def score(
    source: str, episode: int, first: int, length: int, value: float = 1.0, sequence: int = 0
) -> CompositeReward:
    return CompositeReward(
        run_id='run',
        source=source,
        scorer=source,
        sequence=sequence,
        episode=episode,
        first_step=first,
        length=length,
        value=value,
    )


def labels(
    source: str, segments: list[tuple[int, int, int]], values: np.ndarray, version: int = 1
) -> StepRewards:
    e, f, n = (np.array(column, np.uint32) for column in zip(*segments, strict=True))
    return StepRewards(
        run_id='run',
        phase=0,
        version=version,
        part=0,
        parts=1,
        source=source,
        episodes=e,
        first_steps=f,
        lengths=n,
        labels=values.astype(np.float32),
    )


def memory(capacity: int = 1000, margin: int = 100, progress: bool = False) -> Trajectories:
    return Trajectories(OBSERVATION, ACTION, DELAY, capacity, margin, progress=progress)


def filled(
    seed: int = 0,
    sources: tuple[str, ...] = ('sim',),
    episodes: int = 6,
    capacity: int = 1000,
    progress: bool = False,
):
    """A memory and the naive one it should equal, with chunks and segments of odd sizes."""
    naive, m = Naive(seed), memory(capacity, progress=progress)
    truth: dict[tuple[str, int, int], float] = {}
    for number in range(episodes):
        for source in sources:
            steps = int(naive.rng.integers(1, 14))
            cut = int(naive.rng.integers(0, steps))
            ending = 'terminated' if naive.rng.random() < 0.5 else 'truncated'
            if cut:
                m.append(naive.chunk(source, cut))
            m.append(naive.chunk(source, steps - cut, ending))
            for first in range(0, steps, DELAY):
                length = min(DELAY, steps - first)
                m.score(score(source, number, first, length, value=float(naive.rng.normal())))
                values = naive.rng.normal(size=length)
                m.apply(labels(source, [(number, first, length)], values))
                for i in range(length):
                    truth[source, number, first + i] = np.float32(values[i])
            m.evict()
    return m, naive, truth
