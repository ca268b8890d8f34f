"""The simulator's records against what they must add up to."""

import gymnasium
import numpy as np
import pytest

from codetr_ros import records
from codetr_ros.config import SettingsError
from codetr_ros.cores.simulator import Simulator
from codetr_ros.policy.acting import ActingPolicy
from codetr_ros.records import (
    MESSAGE_BYTES,
    CompositeReward,
    EpisodeResult,
    Metrics,
    TaskSpec,
    Transitions,
    TrueRewards,
)
from codetr_ros.seeding import generator
from codetr_ros.simulation import tasks
from codetr_ros.simulation.chunks import CHUNK_STEPS, chunk_steps
from helpers.builders import policy, same, task_spec, tiny
from helpers.builders import run as run_spec
from helpers.simulating import (
    FALLS,
    NEVER_ENDS,
    deterministic,
    kind,
    learnt,
    permit,
    simulate,
    slices,
    true_rewards,
)


@pytest.fixture(scope='module')
def falling():
    """Six phases, the first two random, of a task that ends early; 7 steps a segment."""
    settings = tiny(task=FALLS)
    later = [permit(k, **learnt(FALLS)) for k in range(2, 6)]
    return settings, simulate(settings, [permit(0), permit(1), *later])


@pytest.fixture(scope='module')
def lasting():
    """Six phases of a task that does not end early; 7 divides neither phase nor episode."""
    settings = tiny(task=NEVER_ENDS)
    return settings, simulate(settings, [permit(k, steps=130) for k in range(6)])


both = pytest.mark.parametrize('which', ['falling', 'lasting'])


def test_the_first_slice_says_what_is_simulated():
    said = slices(tiny(task=NEVER_ENDS, r_max=2.5), [])
    assert len(said) == 1
    expected = task_spec(
        source='sim', task=NEVER_ENDS, observation_size=3, action_size=1, horizon=200, r_max=2.5
    )
    assert same(said[0][0], expected)


@both
def test_chunks_concatenate_to_whole_episodes(which, request):
    _, said = request.getfixturevalue(which)
    chunks = kind(Transitions, said)
    assert [chunk.sequence for chunk in chunks] == list(range(len(chunks)))
    last = None
    for chunk in chunks:
        assert chunk.steps == len(chunk.actions) == len(chunk.observations) - 1 > 0
        assert np.abs(chunk.actions).max() <= 1
        if last is None or last.terminated or last.truncated:
            assert chunk.first_step == 0
            assert chunk.episode == (0 if last is None else last.episode + 1)
        else:
            assert (chunk.episode, chunk.first_step) == (
                last.episode,
                last.first_step + last.steps,
            )
            assert (chunk.observations[0] == last.observations[-1]).all()
        last = chunk


@pytest.mark.parametrize(('which', 'task'), [('falling', FALLS), ('lasting', NEVER_ENDS)])
def test_the_environment_repeats_the_episodes_from_seeds_and_actions(which, task, request):
    settings, said = request.getfixturevalue(which)
    environment = tasks.make(task)
    rewards = true_rewards(said)
    ended = None
    for chunk in kind(Transitions, said):
        if chunk.first_step == 0:
            seeds = generator(settings.seed, 'reset', 'sim', chunk.episode)
            observation = environment.reset(int(seeds.integers(2**31)))
        assert (observation == chunk.observations[0]).all()
        for t, action in enumerate(chunk.actions):
            observation, reward, ended = environment.step(action)
            assert (observation == chunk.observations[t + 1]).all()
            assert rewards[chunk.episode][chunk.first_step + t] == np.float32(reward)
        assert chunk.terminated == ended
        length = chunk.first_step + chunk.steps
        assert chunk.truncated == (length == environment.horizon and not ended)


def test_the_two_tasks_end_their_episodes_in_different_ways(falling, lasting):
    assert any(chunk.terminated for chunk in kind(Transitions, falling[1]))
    assert any(chunk.truncated for chunk in kind(Transitions, lasting[1]))
    assert not any(chunk.terminated for chunk in kind(Transitions, lasting[1]))


@both
@pytest.mark.parametrize('composite', ['sum', 'square_sum', 'max_hard'])
def test_composites_are_those_of_the_true_rewards_cut_every_seven_steps(which, composite, request):
    formula = {
        'sum': np.sum,
        'square_sum': lambda r: np.sum(r) * abs(np.sum(r)),
        'max_hard': np.max,
    }[composite]
    settings, said = request.getfixturevalue(which)
    if composite != settings.composite:
        changed = settings.changed({'composite': composite})
        said = simulate(changed, [permit(k, steps=130) for k in range(3)])
    ended = {c.episode for c in kind(Transitions, said) if c.terminated or c.truncated}
    expected = []
    for episode, rewards in true_rewards(said).items():
        for first in range(0, len(rewards), 7):
            segment = rewards[first : first + 7]
            if len(segment) == 7 or episode in ended:
                expected.append((episode, first, len(segment), formula(segment)))
    scores = kind(CompositeReward, said)
    assert [(s.episode, s.first_step, s.length) for s in scores] == [e[:3] for e in expected]
    np.testing.assert_allclose([s.value for s in scores], [e[3] for e in expected], rtol=1e-6)
    assert [score.sequence for score in scores] == list(range(len(scores)))
    assert {(score.source, score.scorer) for score in scores} == {('sim', 'sim')}


def test_a_segment_cut_short_by_termination_still_gets_its_score(falling):
    _, said = falling
    lengths = {c.episode: c.first_step + c.steps for c in kind(Transitions, said) if c.terminated}
    short = {e: n % 7 for e, n in lengths.items() if n % 7}
    assert len(short) > 3
    scored = {s.episode: s.length for s in kind(CompositeReward, said) if s.length < 7}
    assert scored == short


def test_a_terminal_state_reached_at_the_horizon_is_terminated_not_truncated():
    pendulum = gymnasium.spec(FALLS).entry_point
    falls = tiny(task=FALLS, delay=3)
    first = kind(EpisodeResult, simulate(falls, [permit(0)]))[0]
    assert first.terminated
    gymnasium.register('Short-v0', pendulum, max_episode_steps=first.length)
    try:
        said = simulate(falls.changed({'task': 'Short-v0'}), [permit(0)])
    finally:
        del gymnasium.registry['Short-v0']
    ends = [c for c in kind(Transitions, said) if c.first_step + c.steps == first.length]
    assert (ends[0].terminated, ends[0].truncated) == (True, False)
    for chunk in kind(Transitions, said):
        assert not (chunk.terminated and chunk.truncated)


@both
def test_what_belongs_to_a_chunk_follows_it_in_the_same_slice(which, request):
    settings, _ = request.getfixturevalue(which)
    for said in slices(settings, [permit(k) for k in range(2)])[1:]:
        chunk, true, *rest = said
        assert isinstance(chunk, Transitions)
        assert isinstance(true, TrueRewards)
        for name in ('sequence', 'phase', 'episode', 'first_step'):
            assert getattr(chunk, name) == getattr(true, name)
        assert len(true.rewards) == chunk.steps
        kinds = [type(record) for record in rest]
        order = [CompositeReward, EpisodeResult, Metrics]
        assert kinds == sorted(kinds, key=order.index)
        span = range(chunk.first_step + 1, chunk.first_step + chunk.steps + 1)
        for score in kind(CompositeReward, rest):
            assert score.episode == chunk.episode
            assert score.first_step + score.length in span
        assert len(kind(EpisodeResult, rest)) == (chunk.terminated or chunk.truncated)
        assert len(kind(Metrics, rest)) == chunk.phase_end


@both
def test_each_phase_has_exactly_its_steps_and_names_the_scores_due(which, request):
    _, said = request.getfixturevalue(which)
    steps, scores, phase = 0, 0, 0
    due = None
    for record in said:
        if isinstance(record, Transitions):
            if due is not None:
                assert (steps, scores, due) == (130 if which == 'lasting' else 200, due, due)
                steps, scores, phase, due = 0, 0, phase + 1, None
            assert record.phase == phase
            steps += record.steps
            if record.phase_end:
                due = record.scores_due
            else:
                assert record.scores_due == 0
        elif isinstance(record, CompositeReward):
            scores += 1
    assert (phase, scores) == (5, due)


@both
def test_episode_results_are_those_of_the_true_rewards(which, request):
    settings, said = request.getfixturevalue(which)
    rewards, r_max = true_rewards(said), 1.0
    horizon = 200 if which == 'lasting' else 1000
    step = 0
    for record in said:
        if isinstance(record, Transitions):
            step += record.steps
            chunk = record
        if isinstance(record, EpisodeResult):
            assert (record.source, record.purpose) == ('sim', 'training')
            phase_steps = 130 if which == 'lasting' else 200
            assert record.step == step + chunk.phase * (settings.phase_steps - phase_steps)
            assert record.version == chunk.phase - 1
            assert record.episode == chunk.episode
            assert record.length == len(rewards[record.episode])
            assert record.terminated == chunk.terminated
            assert record.true_return == pytest.approx(rewards[record.episode].sum(), rel=1e-5)
            assert record.composite_return == pytest.approx(record.true_return)  # a sum of sums
            assert record.score == pytest.approx(record.true_return / (horizon * r_max))


def test_the_wall_time_of_each_phase_is_said_once(falling):
    _, said = falling
    metrics = kind(Metrics, said)
    assert [m.phase for m in metrics] == [0, 1, 2, 3, 4, 5]
    assert [m.step for m in metrics] == [200, 400, 600, 800, 1000, 1200]
    assert {(m.role, m.node, m.names) for m in metrics} == {('sim', 'sim', ('simulate_seconds',))}
    assert all(0 < m.values[0] < 60 for m in metrics)


def test_a_learnt_policy_acts_with_the_noise_of_its_phase(falling):
    settings, said = falling
    acting = ActingPolicy.from_record(permit(2, **learnt(FALLS)), 4, 1)
    chunks = [chunk for chunk in kind(Transitions, said) if chunk.phase == 2]
    observations = np.concatenate([chunk.observations[:-1] for chunk in chunks])
    actions = np.concatenate([chunk.actions for chunk in chunks])
    noise = generator(settings.seed, 'noise', 'sim', 2).standard_normal((200, 1), dtype=np.float32)
    expected = [acting.act(o, e) for o, e in zip(observations, noise, strict=True)]
    assert actions.tobytes() == np.array(expected).tobytes()
    assert actions.std() > 0.1


def test_random_actions_are_uniform(lasting):
    actions = np.concatenate([chunk.actions for chunk in kind(Transitions, lasting[1])])
    assert -1 <= actions.min() < -0.95
    assert 0.95 < actions.max() <= 1
    assert abs(actions.mean()) < 0.1
    assert abs(actions.std() - np.sqrt(1 / 3)) < 0.03


def test_the_same_seed_gives_the_same_bits(falling):
    settings, said = falling
    later = [permit(k, **learnt(FALLS)) for k in range(2, 6)]
    again = simulate(settings, [permit(0), permit(1), *later])
    assert len(again) == len(said)
    for a, b in zip(deterministic(again), deterministic(said), strict=True):
        assert same(a, b)


def test_another_source_and_another_seed_give_other_episodes():
    settings = tiny(task=NEVER_ENDS)
    names = ('sim', 'sim_2')
    one = kind(Transitions, simulate(settings, [permit(0, sources=names)], source='sim'))
    two = kind(Transitions, simulate(settings, [permit(0, sources=names)], source='sim_2'))
    other = settings.changed({'seed': 1})
    three = kind(Transitions, simulate(other, [permit(0, sources=names)], source='sim'))
    for a, b in ((one, two), (one, three), (two, three)):
        assert (a[0].observations[0] != b[0].observations[0]).any()
        assert (a[0].actions != b[0].actions).any()


def test_policies_that_arrive_early_wait_for_their_turn(falling):
    settings, said = falling
    later = [permit(k, **learnt(FALLS)) for k in range(2, 6)]
    shuffled = simulate(settings, [later[2], permit(1), later[3], later[0], permit(0), later[1]])
    for a, b in zip(deterministic(shuffled), deterministic(said), strict=True):
        assert same(a, b)


def test_nothing_is_done_without_a_permission_and_work_goes_on_when_one_comes():
    settings = tiny(task=NEVER_ENDS)
    simulator = Simulator(run_spec(settings), settings, 'sim')
    work = simulator.work()
    next(work)
    simulator.receive(permit(1))
    assert [next(work), next(work)] == [None, None]
    simulator.receive(permit(0))
    assert next(work)[0].phase == 0


def test_a_simulator_has_finished_after_a_policy_without_steps():
    settings = tiny(task=NEVER_ENDS)
    simulator = Simulator(run_spec(settings), settings, 'sim')
    simulator.receive(permit(1, steps=0, **learnt(NEVER_ENDS)))
    simulator.receive(permit(0))
    work = simulator.work()
    while next(work) is not None:
        assert not simulator.finished
    assert simulator.finished
    assert next(work) is None
    simulator.receive(permit(2, steps=0))  # with overlap a second one follows
    simulator.close()
    simulator.close()
    counters = simulator.report().counters
    assert counters == {'chunks': 1, 'steps': 200, 'scores': 29, 'episodes': 1, 'phases': 1}


def test_a_phase_in_which_only_others_have_steps_is_passed_over():
    settings = tiny(task=NEVER_ENDS, simulators=2, steps=2, phase_steps=1, warmup_steps=1)
    shares = np.array([1, 0], np.uint32)
    first = policy(sources=('sim', 'sim_2'), steps=shares)
    second = permit(1, steps=10, sources=('sim', 'sim_2'))
    said = simulate(settings, [first, second], source='sim_2')
    assert [chunk.phase for chunk in kind(Transitions, said)] == [1]


def test_a_chunk_fits_into_a_message():
    for observation_size, action_size in ((3, 1), (348, 17), (6000, 60), (24_000, 1), (24_999, 1)):
        steps = chunk_steps(observation_size, action_size)
        assert 1 <= steps <= CHUNK_STEPS

        def size(steps, o=observation_size, a=action_size):
            return 4 * ((steps + 1) * o + steps * a)

        assert size(steps) <= MESSAGE_BYTES
        assert steps == CHUNK_STEPS or size(steps + 1) > MESSAGE_BYTES
    assert chunk_steps(25_000, 1) == 0


def test_chunks_of_many_observations_are_shorter_and_still_whole():
    settings = tiny(task='Humanoid-v5', phase_steps=400)
    chunks = kind(Transitions, simulate(settings, [permit(0, steps=400)]))
    assert sum(chunk.steps for chunk in chunks) == 400
    for chunk in chunks:
        assert chunk.observations.nbytes + chunk.actions.nbytes <= MESSAGE_BYTES


def test_a_delay_beyond_the_horizon_is_refused_before_anything_is_simulated():
    settings = tiny(task=NEVER_ENDS, delay=201)
    with pytest.raises(
        SettingsError, match=r"delay = 201: task 'Pendulum-v1' has a horizon of 200"
    ):
        Simulator(run_spec(settings), settings, 'sim')


def test_a_delay_as_long_as_the_episode_gives_one_score_at_its_end():
    settings = tiny(task=NEVER_ENDS, delay=200)
    said = simulate(settings, [permit(k) for k in range(3)])
    scores = [(score.episode, score.length) for score in kind(CompositeReward, said)]
    assert scores == [(0, 200), (1, 200), (2, 200)]


def test_only_records_that_a_simulator_publishes_come_out(falling):
    _, said = falling
    allowed = {TaskSpec, Transitions, TrueRewards, CompositeReward, EpisodeResult, Metrics}
    assert {type(record) for record in said} == allowed
    assert {record.run_id for record in said} == {'run'}
    assert all(type(record) in records.TOPICS for record in said)
