"""What every reward method promises, whatever it does: one contract that all of them inherit."""

from typing import Any, ClassVar

import numpy as np
import pytest
import torch

from codetr_ros.config import IN_PROCESS_ONLY, SCORE_LEARNERS, Composite, Method, Settings
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import F32
from codetr_ros.rewards import registry
from codetr_ros.rewards.base import RewardMethod, RewardModelError, Schedule, segment_steps
from codetr_ros.seeding import generator, seed_torch
from codetr_ros.simulation.composite import composite
from helpers import builders, linear_rewards, planted
from helpers.builders import ACTION as A
from helpers.builders import OBSERVATION as O
from helpers.reward_data import DELAY, LENGTHS, batch_of, equal, filled

pytestmark = pytest.mark.usefixtures('one_thread')


class Contract:
    """Inherit and set `method`, and `changes` to the settings."""

    method: Method
    changes: ClassVar[dict[str, Any]] = {}
    has_unit: ClassVar[bool] = True  # its labels are in a unit
    unit_of_scores: ClassVar[bool] = True  # that of composite rewards per step

    def settings(self, **changes: Any) -> Settings:
        return builders.tiny(**{'method': self.method, 'delay': DELAY} | self.changes | changes)

    def make(self, **changes: Any) -> RewardMethod:
        return registry.make(self.settings(**changes), O, A)

    def trained(self, memory: Trajectories, steps: int = 3, **changes: Any) -> RewardMethod:
        made = self.make(**changes)
        made.prepare(memory)
        self.train(made, memory, range(steps))
        return made

    @staticmethod
    def train(made: RewardMethod, memory: Trajectories, steps: range) -> None:
        for step in steps:
            seed_torch(0, step)
            made.gradient_step(memory, generator(0, step))

    def test_it_is_the_method_that_the_settings_name(self):
        made = self.make()
        assert made.name == self.method == self.settings().method
        assert made.in_process_only == (self.method in IN_PROCESS_ONLY)

    def test_each_step_of_each_segment_gets_a_finite_label_and_nothing_else_does(self):
        memory = filled()
        made = self.trained(memory)
        batch = batch_of(memory, made)
        labels = made.label(batch)
        assert labels.dtype == np.float32 and labels.shape == batch.actions.shape[:2]
        assert np.isfinite(labels).all()
        assert not labels[~segment_steps(batch)].any()
        assert segment_steps(batch).sum() == sum(LENGTHS)

    def test_the_same_seed_gives_the_same_bits(self):
        memory = filled()
        one, other = self.trained(memory), self.trained(memory)
        assert equal(one.state(), other.state())
        batch = batch_of(memory, one)
        assert one.label(batch).tobytes() == other.label(batch).tobytes()

    def test_labelling_changes_neither_the_method_nor_the_random_numbers_to_come(self):
        memory = filled()
        made = self.trained(memory)
        before, random = made.state(), torch.get_rng_state()
        first = made.label(batch_of(memory, made))
        assert equal(made.state(), before) and torch.equal(torch.get_rng_state(), random)
        assert made.label(batch_of(memory, made)).tobytes() == first.tobytes()

    def test_labels_do_not_depend_on_which_other_segments_share_the_batch(self):
        memory = filled()
        made = self.trained(memory)
        batch = batch_of(memory, made)
        together = made.label(batch)[segment_steps(batch)]
        alone = []
        for number in memory.segments.ids():
            one = memory.segments.batch(np.array([number]), made.context)
            alone.append(made.label(one)[segment_steps(one)])
        np.testing.assert_allclose(together, np.concatenate(alone), rtol=1e-4, atol=1e-5)

    def test_a_state_goes_on_where_it_was_taken(self):
        memory = filled()
        made = self.trained(memory)
        state = {name: tensor.clone() for name, tensor in made.state().items()}
        self.train(made, memory, range(3, 6))
        again = self.make(seed=1)  # other initial weights
        again.load_state(state)
        self.train(again, memory, range(3, 6))
        assert equal(again.state(), made.state()) and again.version == made.version
        batch = batch_of(memory, made)
        assert again.label(batch).tobytes() == made.label(batch).tobytes()

    def test_a_state_is_a_copy_of_tensors(self):
        memory = filled()
        made = self.trained(memory)
        state = made.state()
        kept = {name: tensor.clone() for name, tensor in state.items()}
        self.train(made, memory, range(3, 5))
        assert equal(state, kept)

    @pytest.mark.parametrize('damage', ['missing', 'unknown', 'shape', 'type', 'not finite'])
    def test_a_state_that_does_not_fit_is_refused_and_changes_nothing(self, damage):
        memory = filled()
        made, state = self.trained(memory), self.trained(memory, steps=5).state()
        if damage == 'missing':
            del state['target_scale']
        elif damage == 'unknown':
            state['network.other'] = torch.zeros(1)
        elif damage == 'shape':
            state['target_scale'] = torch.ones(2, dtype=torch.float64)
        elif damage == 'type':
            state['target_scale'] = state['target_scale'].float()
        else:
            state['target_scale'] = torch.tensor(float('nan'), dtype=torch.float64)
        before = made.state()
        name = 'network.other' if damage == 'unknown' else 'target_scale'
        with pytest.raises(
            RewardModelError,
            match=f"'{self.method}' refused: {name} .*use those it was saved with",
        ):
            made.load_state(state)
        assert equal(made.state(), before)

    def test_asked_before_it_was_prepared_it_says_what_to_do(self):
        memory, made = filled(), self.make()
        with pytest.raises(
            RewardModelError, match=f"'{self.method}' has no target scale yet: call prepare"
        ):
            made.label(batch_of(memory, made))

    def test_raw_labels_are_the_scaled_ones_times_the_target_scale(self):
        memory = filled()
        scaled, raw = self.trained(memory), self.trained(memory, reward_unit='raw')
        assert scaled.target_scale == raw.target_scale
        if self.unit_of_scores:
            assert scaled.target_scale == memory.segments.score_scale()
        batch = batch_of(memory, scaled)
        factor = scaled.target_scale if self.has_unit else 1.0
        np.testing.assert_allclose(raw.label(batch), scaled.label(batch) * factor, rtol=1e-5)

    def test_labels_change_with_the_version_and_only_then(self):
        memory = filled()
        made = self.trained(memory, steps=0)
        version, before = made.version, made.label(batch_of(memory, made))
        made.prepare(memory)  # of what it has seen
        assert made.version == version
        assert made.label(batch_of(memory, made)).tobytes() == before.tobytes()
        self.train(made, memory, range(3))
        after = made.label(batch_of(memory, made))
        assert (after.tobytes() == before.tobytes()) == (made.version == version)

    def test_it_counts_the_gradient_steps_that_its_schedule_asks_for(self):
        memory = filled()
        made = self.trained(memory)
        learns = made.schedule != Schedule(0, 0)
        assert made.gradient_steps == (3 if learns else 0)

    def test_the_passes_of_labelling_give_every_step_its_label_in_order(self):
        memory = filled()
        made = self.trained(memory)
        ids = memory.segments.ids()[1:4]
        batch = memory.segments.batch(ids, made.context)
        found = np.concatenate(list(made.label_passes(memory, ids)))
        np.testing.assert_allclose(found, made.label(batch)[segment_steps(batch)], rtol=1e-5)


class LearnedContract(Contract):
    """A method that takes gradient steps, by its own group of settings."""

    def test_its_schedule_is_that_of_its_settings(self):
        group = type(self.make()).group
        changes = {f'{group}__first_gradient_steps': 17, f'{group}__gradient_steps': 3}
        assert self.make(**changes).schedule == Schedule(17, 3)

    def test_a_gradient_step_says_its_loss_and_learning_rate(self):
        memory = filled()
        made = self.trained(memory)
        said = made.gradient_step(memory, generator(0))
        assert {'reward_loss', 'learning_rate'} <= said.keys()
        assert all(type(value) is float and np.isfinite(value) for value in said.values())

    def test_scale_and_moments_stay_as_they_were_first_measured(self):
        made = self.trained(filled())
        before = made.state()
        made.prepare(linear_rewards.memory((24,), DELAY, seed=5))
        assert equal(made.state(), before)

    def test_a_state_of_another_task_is_refused(self):
        made, other = self.make(), registry.make(self.settings(), O + 1, A)
        with pytest.raises(RewardModelError, match=r'observation_mean is \(4,\).*expected \(3,\)'):
            made.load_state(other.state())

    def test_a_gradient_step_before_it_was_prepared_is_refused(self):
        with pytest.raises(RewardModelError, match='call prepare'):
            self.make().gradient_step(filled(), generator(0))

    def test_training_that_has_diverged_is_refused_and_changes_nothing(self):
        memory = filled()
        made = self.trained(memory)
        with torch.no_grad():
            *_, last = made.network.parameters()
            last.fill_(float('nan'))
        before = [p.clone() for p in made.network.parameters()]
        group = type(made).group
        with pytest.raises(
            RewardModelError, match=rf'is nan at gradient step 3.*Lower {group}.learning_rate = '
        ):
            made.gradient_step(memory, generator(0))
        for parameter, kept in zip(made.network.parameters(), before, strict=True):
            torch.testing.assert_close(parameter, kept, rtol=0, atol=0, equal_nan=True)


class PerceptronContract(LearnedContract):
    """A network whose inputs nothing bounds but the method itself."""

    def test_an_observation_far_from_those_of_the_warm_up_does_not_blow_rewards_up(self):
        memory = filled()
        made = self.trained(memory)
        batch = batch_of(memory, made)
        mean, std = memory.store.observation_moments()
        far = []
        for deviations in (11, 1000):
            batch.observations[0, 2] = mean + deviations * std
            far.append(made.label(batch))
        np.testing.assert_array_equal(*far)
        bare = self.trained(memory, **{f'{self.method}__normalise_observations': False})
        batch.observations[0, 2] = 11
        near = bare.label(batch)
        batch.observations[0, 2] = 1000
        assert (bare.label(batch)[0, 2] != near[0, 2]).all()


class TestCodetr(LearnedContract):
    method = 'codetr'

    @pytest.mark.parametrize(
        'change',
        [
            {'codetr__embedding': 20},
            {'codetr__layers': 2},
            {'codetr__weights': 'one'},
            {'codetr__window': 200},
        ],
    )
    def test_a_state_of_another_architecture_is_refused(self, change):
        memory = filled()
        made, other = self.trained(memory), self.trained(memory, **change)
        before = made.state()
        with pytest.raises(RewardModelError, match='belongs to other settings or another task'):
            made.load_state(other.state())
        assert equal(made.state(), before)


class TestCodetrAsInThePaper(TestCodetr):
    changes: ClassVar[dict[str, Any]] = {
        'codetr__tokens': 'pair',
        'codetr__schedule': 'peaked',
        'codetr__context': 'window',
        'codetr__window': 10,
    }


class TestCodetrWithContext(TestCodetr):
    changes: ClassVar[dict[str, Any]] = {
        'codetr__context': 'episode',
        'codetr__attention_scope': 'window',
        'codetr__window': 10,
    }


class TestCodetrOfRewardsAlone(TestCodetr):
    changes: ClassVar[dict[str, Any]] = {'codetr__label': 'rhat', 'codetr__head_scale': 'one'}


class TestCodetrOnEvidence(TestCodetr):
    changes: ClassVar[dict[str, Any]] = {'codetr__base': 'evidence'}

    def test_scale_and_moments_stay_as_they_were_first_measured(self):
        """The network's; the regression below looks at all that there is."""
        made = self.trained(filled())
        before = made.state()
        made.prepare(linear_rewards.memory((24,), DELAY, seed=5))
        after = made.state()
        fitted = {name for name in before if name.startswith('base.')}
        assert all(torch.equal(after[x], before[x]) for x in before.keys() - fitted)
        assert not torch.equal(after['base.weights'], before['base.weights'])


class TestCodetrOnEvidenceOfAKindOfScoreThatIsNotKnown(TestCodetrOnEvidence):
    changes: ClassVar[dict[str, Any]] = {
        'codetr__base': 'evidence',
        'codetr__tokens': 'pair',
        'codetr__label': 'rhat',
        'evidence__link': 'choose',
    }


class TestRbt(LearnedContract):
    method = 'rbt'

    def test_a_gradient_step_says_both_losses(self):
        memory = filled()
        said = self.trained(memory).gradient_step(memory, generator(0))
        assert said.keys() == {'reward_loss', 'state_loss', 'learning_rate'}


class TestRbtOfSegments(TestRbt):
    changes: ClassVar[dict[str, Any]] = {
        'rbt__attention_scope': 'segment',
        'codetr__tokens': 'pair',
    }


class TestRrd(PerceptronContract):
    method = 'rrd'


class TestRrdUnbiased(TestRrd):
    changes: ClassVar[dict[str, Any]] = {'rrd__loss': 'unbiased'}


class TestDiaster(PerceptronContract):
    method = 'diaster'


class TestLrr(PerceptronContract):
    method = 'lrr'


class TestLrrOfIndependentSteps(TestLrr):
    changes: ClassVar[dict[str, Any]] = {'lrr__correlation': 'none'}


class TestMilLstm(PerceptronContract):
    method = 'mil_lstm'


class TestMilLstmOfEmbeddings(TestMilLstm):
    changes: ClassVar[dict[str, Any]] = {'mil_lstm__space': 'embedding'}


class TestMlp(PerceptronContract):
    method = 'mlp'


class TestAggregate(PerceptronContract):
    method = 'aggregate'


class TestIrcr(Contract):
    method = 'ircr'
    has_unit = False


class TestEvidence(Contract):
    method = 'evidence'


class TestEvidenceOfAKindOfScoreThatIsNotKnown(TestEvidence):
    changes: ClassVar[dict[str, Any]] = {'evidence__link': 'choose'}


class Rule(Contract):
    """A method that learns nothing; `expected` says what it should give, in the task's unit."""

    @staticmethod
    def expected(value: float, true: F32) -> F32:
        raise NotImplementedError

    def test_it_follows_its_rule(self):
        memory = filled()
        made = self.trained(memory, reward_unit='raw')
        batch = batch_of(memory, made)
        assert batch.true_rewards is not None
        for labels, length, value, true in zip(
            made.label(batch), batch.lengths, batch.values, batch.true_rewards, strict=True
        ):
            np.testing.assert_allclose(
                labels[:length], self.expected(value, true[:length]), rtol=1e-6
            )


class TestLastStep(Rule):
    method = 'none'

    @staticmethod
    def expected(value: float, true: F32) -> F32:
        return np.append(np.zeros(len(true) - 1), value).astype(np.float32)


class TestUniform(Rule):
    method = 'uniform'

    @staticmethod
    def expected(value: float, true: F32) -> F32:
        return np.full(len(true), value / len(true), np.float32)


class TestRandom(Contract):
    method = 'random'

    def test_the_labels_of_a_segment_have_its_sign_and_sum_to_its_score(self):
        memory = filled()
        made = self.trained(memory, reward_unit='raw')
        batch = batch_of(memory, made)
        labels = made.label(batch)
        np.testing.assert_allclose(labels.sum(1), batch.values, rtol=1e-6)
        assert (labels * batch.values[:, None] >= 0).all()

    def test_each_segment_and_each_seed_has_weights_of_its_own(self):
        memory = filled()
        one, other = self.trained(memory), self.trained(memory, seed=1)
        batch = batch_of(memory, one)
        weights = np.concatenate(
            [made.label(batch) / made.label(batch).sum(1, keepdims=True) for made in (one, other)]
        )
        assert len({row.round(6).tobytes() for row in weights}) == len(weights) == 14

    def test_a_segment_has_the_same_labels_with_context_and_in_another_memory(self):
        memory, made = filled(), self.make()
        made.prepare(memory)
        ids = memory.segments.ids()
        plain, after = memory.segments.batch(ids), memory.segments.batch(ids, 4)
        np.testing.assert_array_equal(
            made.label(after)[segment_steps(after)], made.label(plain)[segment_steps(plain)]
        )
        elsewhere = filled(true_rewards=False).segments.batch(ids)
        np.testing.assert_array_equal(made.label(elsewhere), made.label(plain))

    def test_weights_are_uniform_among_all_that_sum_to_one(self):
        """Each of m weights then exceeds x with probability (1 - x)^(m - 1)."""
        memory = linear_rewards.memory((7,) * 900, 7)
        made = self.trained(memory)
        labels = made.label(batch_of(memory, made))
        weights = labels / labels.sum(1, keepdims=True)
        assert weights.shape == (900, 7)
        np.testing.assert_allclose(weights.mean(0), 1 / 7, atol=4 * np.sqrt(6 / 392 / 900))
        np.testing.assert_allclose(weights.var(0), 6 / 392, rtol=0.3)
        for share in (0.1, 0.3, 0.5):
            assert np.mean(weights > share) == pytest.approx((1 - share) ** 6, abs=0.02)


class TestUniformOfSquares(TestUniform):
    changes: ClassVar[dict[str, Any]] = {'composite': 'square_sum'}
    unit_of_scores: ClassVar[bool] = False

    @staticmethod
    def expected(value: float, true: F32) -> F32:
        return np.full(len(true), np.sign(value) * abs(value) ** 0.5 / len(true), np.float32)


class TestUniformOfMaxima(TestUniform):
    changes: ClassVar[dict[str, Any]] = {'composite': 'max'}
    unit_of_scores: ClassVar[bool] = False

    @staticmethod
    def expected(value: float, true: F32) -> F32:
        return np.full(len(true), value, np.float32)

    def test_a_state_in_units_of_scores_is_refused(self):
        made = self.trained(filled())
        state = {'target_scale': made.state()['target_scale']}
        with pytest.raises(RewardModelError, match="'uniform' refused.*composite = 'max'"):
            made.load_state(state)


class TestTrueReward(Rule):
    method = 'true'

    @staticmethod
    def expected(value: float, true: F32) -> F32:
        return true

    def test_a_memory_that_does_not_hold_the_truth_is_refused(self):
        memory = filled(true_rewards=False)
        with pytest.raises(
            RewardModelError, match='no true_rewards; make the memory with true_rewards=True'
        ):
            self.trained(memory).label(memory.segments.batch(memory.segments.ids()))


class TestOnes(Rule):
    method = 'ones'
    has_unit = False

    @staticmethod
    def expected(value: float, true: F32) -> F32:
        return np.ones_like(true)


@pytest.mark.parametrize('kind', Composite.__args__)
def test_methods_differ_in_how_they_distribute_rewards_and_not_in_their_size(kind):
    """In units of scores per step the oracle had 13 times, or 0.02 times, the others' size."""
    delay = 25
    memory = planted.memory(
        planted.progress, lambda r: float(composite(kind, r, 3.0, delay)), delay=delay, segments=80
    )
    sizes = {}
    for method in ('uniform', 'true', 'evidence', 'mlp'):
        changes = {'mlp__learning_rate': 0.01, 'mlp__hidden': (16,)}
        settings = builders.tiny(method=method, delay=delay, composite=kind, **changes)
        made = registry.make(settings, O, A)
        made.prepare(memory)
        Contract.train(made, memory, range(100 if method == 'mlp' else 0))
        labels = made.label(batch_of(memory, made)).astype(np.float64)
        sizes[method] = float(np.sqrt(np.mean(labels**2)))
    assert sizes['uniform'] == pytest.approx(1, rel=1e-5)
    assert all(1 / 3 < size < 3 for size in sizes.values()), sizes


def test_a_method_that_does_not_exist_is_refused_by_name():
    unchecked = builders.tiny().model_copy(update={'method': 'magic'})
    with pytest.raises(
        RewardModelError,
        match=r"method = 'magic'.*choose one of codetr, none, .*true, ones",
    ):
        registry.make(unchecked, O, A)


def test_every_method_that_can_be_configured_can_be_made():
    assert set(registry.METHODS) == set(Method.__args__) - set(SCORE_LEARNERS)
