"""A step reward that jumps where an episode ends in a terminal state, as where a robot falls."""

import numpy as np
import pytest

from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import F64, CompositeReward, TrueRewards
from codetr_ros.rewards import registry
from codetr_ros.rewards.base import RewardModelError, segment_steps
from codetr_ros.rewards.evidence.method import Evidence
from codetr_ros.simulation.composite import composite
from helpers import builders
from helpers.builders import ACTION as A
from helpers.builders import OBSERVATION as O
from helpers.tensors import same

pytestmark = pytest.mark.usefixtures('one_thread')

DELAY = 10
LOST = 1.5


def rewards_of(states: F64, actions: F64, falls: bool) -> F64:
    rewards: F64 = 2 + 0.6 * states[1:, 0] + 0.3 * states[1:, 1] - 0.2 * (actions**2).sum(1)
    rewards[-1] -= LOST * falls
    return rewards


def falling(kind: str, episodes: int = 70) -> Trajectories:
    """Episodes of 4 to 24 steps, of which two of three end by falling."""
    rng = np.random.default_rng(0)
    made = Trajectories(O, A, DELAY, 24 * episodes, 1000, true_rewards=True)
    number = 0
    for episode in range(episodes):
        steps, falls = int(rng.integers(4, 25)), episode % 3 > 0
        states = rng.normal(size=(steps + 1, O)).astype(np.float32)
        actions = rng.uniform(-1, 1, (steps, A)).astype(np.float32)
        wide = states.astype(np.float64), actions.astype(np.float64)
        rewards = rewards_of(*wide, falls).astype(np.float32)
        made.append(
            builders.transitions(
                sequence=episode,
                episode=episode,
                steps=steps,
                observations=states,
                actions=actions,
                terminated=falls,
                truncated=not falls,
            )
        )
        about = {'run_id': 'run', 'source': 'sim', 'episode': episode}
        made.append_true_rewards(
            TrueRewards(**about, sequence=episode, phase=0, first_step=0, rewards=rewards)
        )
        for first in range(0, steps, DELAY):
            part = rewards[first : first + DELAY].astype(np.float64)
            value = composite(kind, part, 1.0, DELAY)
            where = {'scorer': 'sim', 'first_step': first, 'length': len(part)}
            made.score(CompositeReward(**about, **where, sequence=number, value=value))
            number += 1
    return made


def made_of(memory: Trajectories, feature: bool, **changes: object) -> Evidence:
    changes = {'evidence__terminal_feature': feature, **changes}
    settings = builders.tiny(method='evidence', delay=DELAY, memory_steps=10_000, **changes)
    made = registry.make(settings, O, A)
    assert isinstance(made, Evidence)
    return made


def test_a_batch_states_which_of_its_last_steps_were_terminal() -> None:
    memory = falling('sum', episodes=9)
    ids = memory.segments.ids()
    batch = memory.segments.batch(ids)

    assert batch.terminated is not None
    assert batch.terminated.tolist() == memory.segments.terminal(ids).tolist()
    assert batch.terminated.sum() == 6
    part = batch.part(slice(2, 5)).terminated
    assert part is not None
    assert part.tolist() == batch.terminated[2:5].tolist()
    ends = [w.terminated for w in memory.segments.windows(ids, window=3, batch=7)]
    flags = np.concatenate([each for each in ends if each is not None])
    last = np.cumsum(batch.lengths) - 1
    assert flags[last].tolist() == batch.terminated.tolist()
    assert flags.sum() == 6, 'no step before the last one is terminal'


@pytest.mark.parametrize('kind', ['sum', 'sum_square'])
def test_what_is_lost_in_a_terminal_state_is_found_and_the_score_named(kind: str) -> None:
    memory = falling(kind)
    batch = memory.segments.batch(memory.segments.ids())
    assert batch.true_rewards is not None
    assert batch.terminated is not None
    rows, last = np.flatnonzero(batch.terminated), batch.lengths[batch.terminated] - 1
    off, left_out = {}, {}
    for feature in (False, True):
        known = made_of(memory, feature, composite=kind, reward_unit='raw')
        known.prepare(memory)
        labels = known.label(batch).astype(np.float64) * known.unit
        off[feature] = np.abs(labels - batch.true_rewards)[rows, last].mean()
        left_out[feature] = 1 - known.metrics()['left_out_r2']
    chosen = made_of(memory, True, composite=kind, evidence__link='choose')
    chosen.prepare(memory)

    assert off[True] < 0.1 * LOST < off[False]
    assert left_out[True] < 0.1 * left_out[False]
    assert chosen.link.name == kind
    assert chosen.metrics()['link_probability'] > 0.95
    assert 'terminal state -' in chosen.report()['depends_on']


def test_where_nothing_ends_in_a_terminal_state_the_feature_changes_nothing_that_counts() -> None:
    memory = falling('sum', episodes=30)
    for source in memory.store.by_name():
        source.terminated[:] = False
    batch = memory.segments.batch(memory.segments.ids())
    inside = segment_steps(batch)
    labels = []
    for feature in (False, True):
        made = made_of(memory, feature)
        made.prepare(memory)
        labels.append(made.label(batch)[inside])

    assert np.abs(labels[0] - labels[1]).max() < 1e-3 * labels[0].std()


def test_it_is_saved_and_loaded() -> None:
    memory = falling('sum', episodes=20)
    made = made_of(memory, True)
    made.prepare(memory)
    again = made_of(memory, True)
    again.load_state(made.state())
    batch = memory.segments.batch(memory.segments.ids())

    assert same(made.state(), again.state())
    assert np.array_equal(made.label(batch), again.label(batch))
    assert np.array_equal(made.uncertainty(batch).steps, again.uncertainty(batch).steps)
    with pytest.raises(RewardModelError, match='covariance|theta|weights'):
        made_of(memory, False).load_state(made.state())
