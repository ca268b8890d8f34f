"""What the learner will draw is known beforehand, and nothing else need be labelled again."""

from typing import Any

import numpy as np
import pytest

from codetr_ros.config import Settings
from codetr_ros.cores import in_process
from codetr_ros.cores.labeller import Labeller
from codetr_ros.cores.learner import Learner
from codetr_ros.memory import draws
from codetr_ros.memory.batches import StepBatch
from codetr_ros.memory.labelled import LabelledSteps
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import Metrics, Record, StepRewards
from helpers.builders import tiny

WINDOWS = {
    'codetr__labelling': 'window',
    'codetr__window': 5,
    'sac__updates_per_step': 0.1,  # 20 updates of 16 steps: about a third of the memory
    'sac__burst': 7,
    'evaluate_every': 0,
    'task': 'InvertedDoublePendulum-v5',
}


def steps_of(record: StepRewards) -> list[tuple[str, int, int]]:
    """Source, episode and number of each step that has a label."""
    return [
        (record.source, episode, first + i)
        for episode, first, length in zip(
            record.episodes.tolist(),
            record.first_steps.tolist(),
            record.lengths.tolist(),
            strict=True,
        )
        for i in range(length)
    ]


def labels_of(records: list[Record], phase: int) -> dict[tuple[str, int, int], float]:
    """The labels that a phase gave, by step; none twice."""
    parts = [r for r in records if isinstance(r, StepRewards) and r.phase == phase]
    pairs = [p for r in parts for p in zip(steps_of(r), r.labels.tolist(), strict=True)]
    assert len(dict(pairs)) == len(pairs)
    return dict(pairs)


def labelled(**changes: Any) -> tuple[Settings, list[Record]]:
    settings = tiny(**(WINDOWS | changes))
    records: list[Record] = []
    in_process.run(settings, 'run', observe=records.append)
    return settings, records


class Watched:
    """Sees every step that a learner draws, and both sides' labels after each phase."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.versions: list[set[int]] = []  # of each draw
        self.places: list[set[int]] = []  # drawn, by phase
        self.told: list[set[int]] = []  # that the reward side knew of
        self.memories: dict[str, list[tuple[bytes, ...]]] = {'learner': [], 'reward': []}
        sample, learn, label = LabelledSteps.sample, Learner._learn, Labeller._label
        told = draws.drawn

        def sample_steps(steps: LabelledSteps, rng: Any, batch: int) -> StepBatch:
            again = np.random.Generator(type(rng.bit_generator)())
            again.bit_generator.state = rng.bit_generator.state
            places = again.integers(0, steps.count, batch)
            self.places[-1].update(places.tolist())
            self.versions.append(set(steps.versions()[places].tolist()))
            return sample(steps, rng, batch)

        def learning(core: Learner, phase: int, memory: Trajectories, learns: bool) -> Any:
            self.places.append(set())
            yield from learn(core, phase, memory, learns)
            self._note('learner', memory)

        def labelling(core: Labeller, phase: int, memory: Trajectories, method: Any) -> Any:
            yield from label(core, phase, memory, method)
            self._note('reward', memory)

        def drawn(settings: Settings, phase: int, memory: Trajectories) -> Any:
            found = told(settings, phase, memory)
            self.told.append(set(found.tolist()))
            return found

        monkeypatch.setattr(LabelledSteps, 'sample', sample_steps)
        monkeypatch.setattr(Learner, '_learn', learning)
        monkeypatch.setattr(Labeller, '_label', labelling)
        monkeypatch.setattr(draws, 'drawn', drawn)

    def _note(self, side: str, memory: Trajectories) -> None:
        by_source = memory.labelled.columns()['labels']
        labels = [part.tobytes() for _, part in sorted(by_source.items())]
        self.memories[side].append((*labels, memory.labelled.versions().tobytes()))


@pytest.mark.parametrize(
    'changes',
    [
        {},
        {'overlap': True, 'simulators': 2, 'task': 'Reacher-v5'},
        {'codetr__labelling': 'segment'},
    ],
)
def test_whatever_the_learner_draws_has_the_newest_label_and_fewer_are_given(monkeypatch, changes):
    seen = Watched(monkeypatch)
    settings, records = labelled(relabel='drawn', **changes)
    learning = settings.phases - settings.warmup_phases + 1
    newest = [r.version for r in records if isinstance(r, StepRewards) and r.part == 0]
    assert len(newest) == learning and len(set(newest)) == learning

    for phase in {r.phase for r in records if isinstance(r, StepRewards)}:
        sources = [r.source for r in records if isinstance(r, StepRewards) and r.phase == phase]
        assert len(sources) == settings.simulators, 'a part for each, as queues are deep'

    bursts = -(-20 // settings.sac.burst)
    expected = [{version} for version in newest for _ in range(bursts)]
    assert seen.versions == expected
    assert [drawn for drawn in seen.places if drawn] == seen.told

    learner = seen.memories['learner'][settings.warmup_phases - 1 :]
    assert learner == seen.memories['reward'], 'the memories have the same labels'
    assert any(len(set(np.frombuffer(ages[-1], np.int64).tolist())) > 1 for ages in learner)

    monkeypatch.undo()
    _, whole = labelled(**changes)
    counts = [
        sum(len(r.labels) for r in run if isinstance(r, StepRewards)) for run in (records, whole)
    ]
    assert counts[0] < (0.75 if settings.codetr.labelling == 'window' else 1) * counts[1]


def test_ages_are_those_of_the_steps_in_the_memory():
    settings, records = labelled(relabel='drawn', memory_steps=10_000)
    version_of: dict[tuple[str, int, int], int] = {}
    ages = []
    for record in records:
        if isinstance(record, StepRewards):
            version_of |= dict.fromkeys(steps_of(record), record.version)
            newest = record.version
        elif isinstance(record, Metrics) and 'label_age_mean' in record.names:
            said = dict(zip(record.names, record.values.tolist(), strict=True))
            # the metrics of a phase follow its labels
            true = [newest - version for version in version_of.values()]
            assert said['label_age_max'] == max(true)
            assert said['label_age_mean'] == pytest.approx(np.mean(true))
            ages.append(max(true))
    assert len(ages) == settings.phases - settings.warmup_phases + 1 and max(ages) > 0


def test_labels_of_what_is_drawn_are_those_that_labelling_all_gives():
    settings, records = labelled(relabel='drawn')
    _, whole = labelled()
    phase = settings.warmup_phases  # the first in which labels are given again
    some, every = labels_of(records, phase), labels_of(whole, phase)
    assert some.keys() < every.keys() and len(some) < 0.75 * len(every)
    new = every.keys() - labels_of(whole, phase - 1).keys()
    assert new < some.keys()
    found = np.array(list(some.values()))
    np.testing.assert_allclose(found, [every[step] for step in some], rtol=0, atol=1e-5)
    before = labels_of(whole, phase - 1)
    changed = [step for step in some if step in before]
    moved = np.array([some[step] - before[step] for step in changed])
    assert np.abs(moved).max() > 1e-3, 'the model has learnt in between'


def test_a_method_whose_labels_stay_labels_nothing_again():
    settings, records = labelled(relabel='drawn', method='uniform')
    steps = [step for r in records if isinstance(r, StepRewards) for step in steps_of(r)]
    assert len(set(steps)) == len(steps) > settings.steps // 2


def test_nothing_labelled_means_nothing_drawn():
    memory = Trajectories(3, 2, 4, 100, 10)
    assert draws.drawn(tiny(), 0, memory).tolist() == []


def test_the_bursts_of_a_phase_are_all_of_its_updates_whose_streams_differ():
    settings = tiny(phase_steps=200, sac__updates_per_step=0.5, sac__burst=30)
    bursts = list(draws.bursts(settings, 3))
    assert [(b.first, b.updates) for b in bursts] == [(0, 30), (30, 30), (60, 30), (90, 10)]
    assert draws.updates_of(settings, 3) == 100
    first = [int(b.rng.integers(1 << 62)) for b in (*bursts, *draws.bursts(settings, 4))]
    assert len(set(first)) == len(first)
