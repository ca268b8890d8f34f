"""Well-formed lies, replays and junk on all topics, from somebody who reads everything, and a
second server of `fetch_phase`: the run ends as if nobody had been there.
"""

import re
import signal
from collections import Counter
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS')

from codetr_ros.bags.verify import verify
from codetr_ros.nodes.signing import new_key
from codetr_ros.records import (
    TOPICS,
    Commit,
    CompositeReward,
    EpisodeResult,
    Metrics,
    Policy,
    Presence,
    RunSpec,
    StepRewards,
    TaskSpec,
    Transitions,
    TrueRewards,
)
from codetr_ros.records.roles import read_by
from helpers import stopping
from helpers.builders import tiny, transitions
from helpers.lies import FIRST, LIES, Liar
from helpers.nodes import Nodes, domain
from helpers.runs import finish, start, write

pytestmark = pytest.mark.slow

ROUNDS, LIES_ON_A_TOPIC, LARGE_IN_A_ROUND = 7, 9, 12
"""The large ones have a megabyte. In a round, fewer are on a topic than its queues hold: 16."""
MOST_GROWTH = 4 << 20
"""How many bytes of memory a node may take more in two of the rounds: it keeps nothing of the 12
megabytes of one. In others the middleware takes room for as many as wait at once, and keeps it: in
the first, and on a busy machine, where more of them wait, in several.
"""
HEARD = (
    RunSpec, Presence, TaskSpec, Policy, Transitions, CompositeReward, Commit, StepRewards,
    EpisodeResult, TrueRewards, Metrics,
)  # fmt: skip
NODES = ('record', 'reward', 'learner', 'evaluate')
"""Those that go on while the simulator is held."""


TOPICS_OF_NODES = [
    (node, TOPICS[kind]) for node in NODES for kind in (Presence, *read_by(node)) if kind in HEARD
]


def large() -> np.ndarray:
    return np.zeros((125_000, 2), np.float32)


def tell(liar, nodes, refused):
    """Tell lies, not faster than everybody reads: a flood would overrun the queues of a topic.

    Returns:
        How many bytes each node takes more in each round but the first.
    """
    before, sizes = Counter(liar.told), []
    chunk = transitions(
        source='stranger', steps=124_999, observations=large(), actions=large()[:-1]
    )
    for _ in range(ROUNDS):
        for kind in HEARD * LIES_ON_A_TOPIC:
            liar.tell_something(kind)
        for _ in range(LARGE_IN_A_ROUND):
            liar.tell_record(chunk)
        liar.until(lambda: read(liar, refused, before))
        sizes.append(nodes.memory())
    return {name: [b[name] - a[name] for a, b in pairwise(sizes)] for name in sizes[0]}


def read(liar, refused, before):
    """Whether all that was told since then has been refused by all that read it."""
    return all(
        refused(node, topic) >= liar.told[topic] - before[topic] for node, topic in TOPICS_OF_NODES
    )


def reaches_everybody(liar, refused):
    """Whether all nodes have found this one: what is published before that may be lost."""
    if liar.counters == liar.counted:
        return False
    liar.counted = dict(liar.counters)
    lacking = {topic for node, topic in TOPICS_OF_NODES if not refused(node, topic)}
    for kind in (kind for kind in HEARD if TOPICS[kind] in lacking):
        # a node logs the first ten refusals on a topic: on a slow machine all of them are these
        liar.tell(kind, bytes(9))
        liar.tell_again(kind)
    return not lacking


@dataclass
class Outcome:
    """What the lies have done.

    Attributes:
        growth: bytes that each node takes more in each round of them.
        before: what was told before it was certain that it would reach everybody.
        expected: the digests of a run that is left alone.
    """

    growth: dict[str, list[int]]
    before: Counter[str]
    expected: dict[str, str]


@pytest.fixture(scope='module')
def lied_to(tmp_path_factory):
    """A run with a key, what it was told, and the digests of one that is left alone."""
    folder = tmp_path_factory.mktemp('lied-to')
    settings = tiny()
    alone = start(write(settings, folder / 'alone'), folder / 'alone', '--in-process')
    with (
        domain(),
        Nodes(settings, folder / 'run', stopping.starter(), new_key()) as nodes,
        Liar(nodes) as liar,
    ):

        def refused(node, topic):
            return int(liar.counters.get(node, {}).get(f'refused {topic}', 0))

        for kind in FIRST:
            liar.tell_record(LIES[kind](liar, liar.rng))
        nodes.start_before(liar)
        # in the midst of the run: whoever has finished has written its report
        liar.until(lambda: nodes.is_stopped('sim'))
        liar.until(lambda: liar.committed(stopping.PHASE - 1) and liar.heard(*HEARD))
        # nobody has anything still to read of which a copy could overtake the original
        liar.until(lambda: all(liar.presence[name].waiting > 2 for name in NODES))
        liar.until(lambda: reaches_everybody(liar, refused))
        before = Counter(liar.told)
        for kind in HEARD:
            liar.tell_again(kind)
        growth = tell(liar, nodes, refused)
        liar.start_services('fetch_phase', 'sim/fetch_phase', 'learner/fetch_phase')
        nodes.send(signal.SIGKILL, 'sim', 'reward')
        nodes.wait('sim', 'reward')
        nodes.start('sim')
        nodes.start('reward')
        liar.until(lambda: None not in nodes.codes().values())
        expected, _ = finish(alone, folder / 'alone')
        yield nodes, liar, Outcome(growth, before, expected)


def test_a_run_that_is_lied_to_ends_with_the_weights_of_one_that_is_left_alone(lied_to):
    nodes, _, it = lied_to
    assert set(nodes.codes().values()) == {0}, [nodes.log(name) for name in nodes.names]
    assert nodes.report('learner')['policy_sha256'] == it.expected['policy_sha256']
    assert nodes.report('reward')['reward_model_sha256'] == it.expected['reward_model_sha256']
    for name in nodes.names:
        assert nodes.report(name)['finished']
        assert 'Traceback' not in nodes.log(name)


def test_each_lie_is_refused_by_all_that_read_it_and_counted(lied_to):
    nodes, liar, it = lied_to
    for name in ('record', 'learner', 'evaluate'):  # those that were not killed
        refused = nodes.report(name)['refused']
        for kind in (Presence, *read_by(name)):
            told = liar.told[TOPICS[kind]]
            refusals = refused.get(TOPICS[kind], 0)
            seen = liar.counters[name], nodes.report(name), nodes.log(name)[-3000:]
            assert told - it.before[TOPICS[kind]] <= refusals <= told, (name, kind, *seen)
        said = re.findall(r"refused on '\w+' \(number \d+\): (.*)", nodes.log(name))
        assert sum('is not signed with the key of this run' in why for why in said) > 10
        assert any('is a repetition of an old message' in why for why in said)


def test_what_strangers_publish_takes_no_memory(lied_to):
    _, _, it = lied_to
    assert all(sorted(grown)[1] < MOST_GROWTH for grown in it.growth.values()), it.growth


def test_false_answers_of_a_second_server_are_refused_and_the_true_ones_awaited(lied_to):
    nodes, liar, _ = lied_to
    # those that were started again asked the recorder, and whom else the middleware had found
    for name in ('sim', 'reward'):
        refused = nodes.report(name)['refused'].get('fetch_phase', 0)
        assert refused <= liar.asked
        assert 'the run has begun, phase' in nodes.log(name)
        said = "an answer of '/run_run/fetch_phase' to the question for phase" in nodes.log(name)
        assert said == (refused > 0)


def test_the_bag_of_a_run_that_was_lied_to_is_sound(lied_to):
    nodes, _, _ = lied_to
    verdict = verify(nodes.folder / 'bag')
    assert verdict.sound, verdict.report()['findings']
