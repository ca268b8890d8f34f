"""A simulator that has its policies from the start, and what it yields."""

import numpy as np

from codetr_ros.config import Settings
from codetr_ros.cores.simulator import Simulator
from codetr_ros.policy.actor import Actor, weights_bytes
from codetr_ros.policy.network import describe_network
from codetr_ros.records import (
    Metrics,
    TrueRewards,
)
from codetr_ros.seeding import seed_torch
from codetr_ros.simulation import tasks
from helpers.builders import policy
from helpers.builders import run as run_spec

FALLS = 'InvertedPendulum-v5'  # within some ten steps under the random policy
NEVER_ENDS = 'Pendulum-v1'  # 200 steps


def permit(phase, steps=200, sources=('sim',), **changes):
    steps = np.full(len(sources), steps, np.uint32)
    return policy(phase=phase, version=phase - 1, sources=sources, steps=steps, **changes)


def learnt(task, seed=0):
    """What a learner says of a fresh policy for the task: fields of a Policy."""
    environment = tasks.find(task)
    sizes = {FALLS: (4, 1), NEVER_ENDS: (3, 1)}[environment.name]
    seed_torch(seed)
    actor = Actor(*sizes, (16, 16))
    weights = weights_bytes(actor)
    return {'random': False, 'network': describe_network(*sizes, (16, 16)), 'weights': weights}


def slices(settings: Settings, policies, source='sim'):
    """What a simulator yields, slice by slice, when it has the policies from the start."""
    simulator = Simulator(run_spec(settings), settings, source)
    for each in policies:
        simulator.receive(each)
    out = []
    for records_of_slice in simulator.work():
        if records_of_slice is None:
            break
        out.append(records_of_slice)
    simulator.close()
    return out


def simulate(*arguments, **named):
    return [record for each in slices(*arguments, **named) for record in each]


def kind(kind, said):
    return [record for record in said if type(record) is kind]


def true_rewards(said):
    """The environment's rewards, episode by episode."""
    episodes = {}
    for record in kind(TrueRewards, said):
        assert record.first_step == len(episodes.setdefault(record.episode, []))
        episodes[record.episode].extend(record.rewards.astype(np.float64))
    return {number: np.array(rewards) for number, rewards in episodes.items()}


def deterministic(said):
    """All but the wall time, which differs from run to run."""
    return [record for record in said if not isinstance(record, Metrics)]
