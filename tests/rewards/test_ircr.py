"""IRCR: the guidance reward of a segment among all scores so far."""

import numpy as np

from codetr_ros.cores.labeller import Labeller
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import Commit, StepRewards
from codetr_ros.rewards.ircr import Ircr
from helpers import builders
from helpers.builders import ACTION as A
from helpers.builders import OBSERVATION as O
from helpers.commits import committed

DELAY = 5


class Scored:
    """A memory that is given one episode after the other, a segment each, and their scores."""

    def __init__(self, capacity=1000):
        self.memory = Trajectories(O, A, DELAY, capacity, 1000)
        self.episodes = 0

    def add(self, *values):
        for value in values:
            number = self.episodes
            self.memory.append(
                builders.transitions(sequence=number, episode=number, truncated=True)
            )
            self.memory.score(builders.score(episode=number, length=DELAY, value=value))
            self.episodes += 1
        return self.memory


def guidance(method: Ircr, memory: Trajectories) -> list[float]:
    """The label of each segment, which all of its steps must have."""
    labels = method.label(memory.segments.batch(memory.segments.ids()))
    assert (labels == labels[:, :1]).all()
    return labels[:, 0].tolist()


def test_each_step_gets_its_segments_score_normalised_to_between_0_and_1():
    scored = Scored()
    memory = scored.add(-3.0, 1.0, 5.0)
    method = Ircr(builders.tiny(method='ircr', delay=DELAY), O, A)
    method.prepare(memory)
    assert guidance(method, memory) == [0.0, 0.5, 1.0]


def test_random_scores_of_any_sign_and_size_stay_between_0_and_1():
    rng = np.random.default_rng(0)
    for scale in (1e-6, 1.0, 1e6):
        memory = Scored().add(*(rng.normal(size=20) * scale).tolist())
        method = Ircr(builders.tiny(method='ircr', delay=DELAY), O, A)
        method.prepare(memory)
        found = guidance(method, memory)
        assert min(found) == 0.0 and max(found) == 1.0


def test_where_all_scores_are_equal_no_step_is_better_than_another():
    memory = Scored().add(7.0, 7.0)
    method = Ircr(builders.tiny(method='ircr', delay=DELAY), O, A)
    method.prepare(memory)
    assert guidance(method, memory) == [0.0, 0.0]


def test_a_new_extreme_raises_the_version_and_a_score_in_between_does_not():
    scored = Scored()
    method = Ircr(builders.tiny(method='ircr', delay=DELAY), O, A)
    method.prepare(scored.add(0.0, 4.0))
    first = method.version
    method.prepare(scored.add(3.0))
    assert method.version == first
    assert guidance(method, scored.memory) == [0.0, 1.0, 0.75]
    method.prepare(scored.add(8.0))
    assert method.version == first + 1
    assert guidance(method, scored.memory) == [0.0, 0.5, 0.375, 1.0]


def test_extremes_are_those_of_all_time_though_their_segments_are_gone():
    scored = Scored(capacity=10)
    method = Ircr(builders.tiny(method='ircr', delay=DELAY), O, A)
    method.prepare(scored.add(-10.0, 10.0))
    scored.add(0.0, 5.0)
    assert scored.memory.evict() == 10
    method.prepare(scored.memory)
    assert guidance(method, scored.memory) == [0.5, 0.75]


def test_old_segments_are_labelled_anew_in_the_phases_in_which_an_extreme_moves_and_only_then():
    """The reward side as a whole: what goes out in each phase."""
    settings = builders.tiny(
        method='ircr', delay=DELAY, phase_steps=DELAY, warmup_steps=DELAY, memory_steps=1000
    )
    core = Labeller(builders.run(settings), settings, 'reward', None)
    core.receive(builders.task_spec())
    work = core.work()
    sent: list[dict[int, float]] = []
    commits: list[Commit] = []
    for phase, value in enumerate((1.0, 2.0, 1.5, 0.0)):
        where = {'sequence': phase, 'episode': phase}
        records = (
            builders.transitions(
                phase=phase, truncated=True, phase_end=True, scores_due=1, **where
            ),
            builders.score(length=DELAY, value=value, **where),
        )
        made = committed(
            *records, before=commits, labels_digest=core._intake.labels.get(phase - 1, '')
        )
        commits.append(made)
        for record in (*records, made):
            core.receive(record)
        labels: dict[int, float] = {}
        while (out := next(work)) is not None:
            for part in out:
                if isinstance(part, StepRewards):
                    labels |= dict(
                        zip(part.episodes.tolist(), part.labels[::DELAY].tolist(), strict=True)
                    )
        sent.append(labels)
    assert sent == [{0: 0.0}, {0: 0.0, 1: 1.0}, {2: 0.5}, {0: 0.5, 1: 1.0, 2: 0.75, 3: 0.0}]
