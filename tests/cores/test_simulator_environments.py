"""Several environments of one simulator: each is a source of its own."""

import numpy as np
import pytest

from codetr_ros.cores.simulator import Simulator
from codetr_ros.records import (
    Metrics,
    RecordError,
    Transitions,
)
from helpers.builders import policy, same, tiny
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
)


def several(task, envs, phases=4):
    """Slices of a simulator with some environments: two random phases, then two learnt ones."""
    settings = tiny(task=task, envs=envs, phase_steps=101 * envs)
    names = settings.sources_of('sim')
    policies = [permit(k, 101, names, **(learnt(task) if k > 1 else {})) for k in range(phases)]
    return settings, slices(settings, policies)


@pytest.mark.parametrize('task', [FALLS, NEVER_ENDS])
def test_each_environment_is_the_source_that_a_simulator_of_its_name_would_be(task):
    settings, said = several(task, 3)
    names = settings.sources_of('sim')
    assert names == ('sim-1', 'sim-2', 'sim-3')
    own = settings.changed({'envs': 1, 'simulators': 3})
    policies = [permit(k, 101, names, **(learnt(task) if k > 1 else {})) for k in range(4)]
    for name in names:
        expected = deterministic(simulate(own, policies, source=name))
        records_of_it = [r for one in said for r in deterministic(one) if r.source == name]
        assert len(records_of_it) == len(expected) > 10
        assert all(map(same, records_of_it, expected))


def test_environments_take_turns_in_the_order_of_their_names():
    _, said = several(NEVER_ENDS, 3)
    assert [spec.source for spec in said[0]] == ['sim-1', 'sim-2', 'sim-3']
    for one in said[1:]:
        chunks = [chunk.source for chunk in kind(Transitions, one)]
        assert chunks == ['sim-1', 'sim-2', 'sim-3']
    ends = [kind(Metrics, one) for one in said if kind(Metrics, one)]
    assert [m.node for (m,) in ends] == ['sim'] * 4  # one for each phase, of all environments


def test_an_environment_without_steps_in_a_phase_is_passed_over():
    settings = tiny(task=NEVER_ENDS, envs=3)
    names = settings.sources_of('sim')
    some = policy(sources=names, steps=np.array([1, 0, 2], np.uint32))
    said = simulate(settings, [some, permit(1, 1, names)])
    chunks = [(c.phase, c.source, c.sequence, c.steps) for c in kind(Transitions, said)]
    assert chunks == [
        *((0, 'sim-1', 0, 1), (0, 'sim-3', 0, 2)),
        *((1, 'sim-1', 1, 1), (1, 'sim-2', 0, 1), (1, 'sim-3', 1, 1)),
    ]
    assert [m.phase for m in kind(Metrics, said)] == [0, 1]


def test_a_policy_that_leaves_out_an_environment_is_refused():
    settings = tiny(task=NEVER_ENDS, envs=2)
    simulator = Simulator(run_spec(settings), settings, 'sim_2')
    names = ('sim-1', 'sim-2', 'sim_2-1', 'robot')
    with pytest.raises(RecordError, match=r"not 'sim_2-2': start the run with simulators=3"):
        simulator.receive(permit(0, sources=names))
    simulator.close()


def test_counts_are_those_of_all_environments():
    settings = tiny(task=NEVER_ENDS, envs=2)
    simulator = Simulator(run_spec(settings), settings, 'sim')
    names = settings.sources_of('sim')
    simulator.receive(permit(0, 200, names))
    for said in simulator.work():
        if said is None:
            break
    simulator.close()
    counters = simulator.report().counters
    assert counters == {'chunks': 2, 'steps': 400, 'scores': 58, 'episodes': 2, 'phases': 1}
