"""What learns from a bag that is played ends with the weights of the run that was recorded."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='needs ROS')

from codetr_ros.bags.reader import Bag
from codetr_ros.bags.topics import BagTopic
from codetr_ros.bags.writer import McapWriter
from codetr_ros.config import Settings
from codetr_ros.runs import checkpoints
from codetr_ros.runs import folder as run_folder
from helpers.builders import tiny
from helpers.forked import codetr
from helpers.nodes import NAMESPACE, Nodes, domain
from helpers.runs import DEADLINE, train


@dataclass
class Recorded:
    """A run over topics that has ended."""

    settings: Settings
    folder: Path
    summary: dict[str, Any]


@pytest.fixture(scope='module')
def recorded(tmp_path_factory):
    """Overlap: two phases are under way at once. All labels, so that they can be played too. Two
    environments: the simulator that is played speaks for two sources. Irregular segments, of which
    some have no score.
    """
    uneven = {'delay': '3:11', 'score_missing': 0.2}
    settings = tiny(overlap=True, record_relabels='all', evaluate_every=0, envs=2, **uneven)
    folder = tmp_path_factory.mktemp('recorded') / 'run'
    with domain():
        summary, _ = train(settings, folder)
    return Recorded(settings, folder, summary)


def play(bag: Path, nodes: Nodes, *live: str) -> str:
    """Play a bag to these nodes until all have ended; what the player said."""
    with nodes:
        for name in live:
            nodes.start(name)
        flags = ('--to', *live, '--namespace', NAMESPACE)
        player = codetr('bag', 'play', str(bag), *flags, environment=os.environ)
        said, _ = player.communicate(DEADLINE)
        assert player.returncode == 0, said + ''.join(map(nodes.log, live))
        assert nodes.wait() == dict.fromkeys(live, 0), ''.join(map(nodes.log, live))
    for name in live:
        report = nodes.report(name)
        assert report['lost'] == report['refused'] == report['duplicated'] == {}
        assert report['fetched'] == {} and report['finished']
    assert 'Traceback' not in said
    return said


@pytest.mark.slow
@pytest.mark.parametrize(
    'live', [('reward',), ('learner',), ('reward', 'learner')], ids=' and '.join
)
def test_who_learns_from_the_bag_ends_with_the_weights_of_the_run(recorded, tmp_path, live):
    with domain():
        nodes = Nodes(recorded.settings, tmp_path / 'played')
        said = play(recorded.folder, nodes, *live)
    digests = {'reward': 'reward_model_sha256', 'learner': 'policy_sha256'}
    for name in live:
        assert nodes.report(name)[digests[name]] == recorded.summary[digests[name]]
    assert 'played 6 of 6 phases: 1200 steps' in said


@pytest.mark.slow
def test_the_bag_of_a_run_that_was_stopped_teaches_what_the_run_had_learnt_by_then(
    recorded, tmp_path
):
    bag = tmp_path / 'bag'
    copy_up_to(Bag(recorded.folder / run_folder.BAG), bag, phase=3)
    with domain():
        nodes = Nodes(recorded.settings, tmp_path / 'played')
        play(bag, nodes, 'reward')
    where = recorded.folder / run_folder.CHECKPOINTS / 'reward-000003'
    assert nodes.report('reward')['reward_model_sha256'] == checkpoints.digest(
        checkpoints.of_model(checkpoints.load(where)[0])
    )


def copy_up_to(source: Bag, folder: Path, phase: int) -> None:
    """Copy a bag up to what the recorder had got when it was stopped: amid the next phase."""
    topics = [BagTopic(topic.name, topic.type, 10, False) for topic in source.topics.values()]
    writer = McapWriter(folder, topics)
    chunks_left = 2
    for raw in source.raw():
        entry = source.entry(raw)
        if getattr(entry.record, 'phase', 0) > phase:
            chunks_left -= 1
        if not chunks_left:
            break
        writer.write(raw.channel.topic, bytes(raw.data), raw.log_time, raw.publish_time)
    writer.close()
