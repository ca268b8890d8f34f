"""The player among real nodes that it waits for, or whose trouble it sees."""

import json
import os
import signal
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from codetr_ros.bags.definitions import decode, encode
from codetr_ros.bags.topics import BagTopic
from codetr_ros.bags.writer import McapWriter
from codetr_ros.records import TOPICS, Commit, CompositeReward, RunSpec, Transitions
from codetr_ros.records.chain import Chain
from codetr_ros.records.fields import type_name
from codetr_ros.records.roles import command
from codetr_ros.ros.link import Link
from codetr_ros.runs import folder as run_folder
from helpers.bags import SETTINGS, a_run, ours, topic_of
from helpers.builders import run, same
from helpers.forked import codetr
from helpers.playing import NAMESPACE, output, process


def uniform(phases=3):
    """A run whose reward node has next to nothing to do."""
    settings = SETTINGS.changed({'method': 'uniform', 'evaluate_every': 0})
    return [run(settings), *a_run(phases)[1:]]


@contextmanager
def player(bag: Path, *flags: str):
    node = codetr(
        'bag', 'play', str(bag), '--namespace', NAMESPACE, *flags, environment=os.environ
    )
    try:
        yield node
    finally:
        if node.poll() is None:
            node.kill()
        node.communicate()


def test_who_is_missing_is_named_with_what_starts_it(ros_domain, tmp_path):
    with player(ours(tmp_path / 'bag', uniform()), '--deadline', '5') as node:
        said = output(node)
    assert node.returncode == 1
    assert (
        f'gave up after 5 s: it waits for reward (start it with `{command("reward")}` in this '
        'namespace). A larger --deadline makes it wait longer' in said
    )
    assert 'Traceback' not in said


def test_a_phase_that_a_node_lacks_is_sent_again(ros_domain, tmp_path):
    bag = ours(tmp_path / 'bag', uniform(phases=1))
    with process('deaf', f'folder:={tmp_path}') as deaf, player(bag) as node:
        said, heard = output(node), output(deaf)
    assert (node.returncode, deaf.returncode) == (0, 0), said + heard
    report = json.loads(run_folder.report_path(tmp_path, 'reward', 'reward').read_text())
    assert report['fetched'] == {'transitions': 4}
    assert '/r/reward lacks something of phase 0: sending it again' in said
    assert said.index('phase 0 is played') < said.index('everything is played and learnt from')


GONE = [
    pytest.param(
        signal.SIGINT, 'reward /r/reward stopped before everything was played', id='ended'
    ),
    pytest.param(
        signal.SIGKILL,
        'waits for reward, to have learnt from phase 0, and reward /r/reward has been silent',
        id='killed',
        marks=pytest.mark.slow,
    ),
]


@pytest.mark.parametrize(('number', 'what'), GONE)
def test_a_node_that_is_gone_amid_the_bag_is_named(ros_domain, tmp_path, number, what):
    bag = ours(tmp_path / 'bag', uniform())
    with process('deaf') as deaf, player(bag, '--deadline', '25') as node:
        for line in node.stdout:
            if 'phase 0 is played' in line:
                break
        deaf.send_signal(number)
        said = output(node)
    assert node.returncode == 1
    assert what in said
    assert 'Traceback' not in said


def test_a_learner_of_another_run_is_refused_naming_both_values(ros_domain, tmp_path):
    bag = ours(tmp_path / 'bag', uniform())
    with (
        process('learner', 'delay:=6', 'steps:=60', 'phase_steps:=20') as learner,
        player(bag, '--to', 'learner') as node,
    ):
        said = output(node)
        learner.kill()
    assert node.returncode == 1
    assert 'the recorded run has task =' in said or 'the recorded run has delay = 5' in said
    assert 'start the learner with' in said


HEARD = (RunSpec, Transitions, CompositeReward, Commit)


@pytest.fixture
def listener(play):
    """Somebody who is no part of the run, and what he hears."""
    play(roles=())
    link = Link('listener')
    link.heard, link.times = [], []
    for kind in HEARD:
        link.subscribe(kind, lambda kind, m: link.heard.append(decode(kind, m)))
    yield link
    link.close()


def hear(listener) -> None:
    """Take in what has arrived."""
    listener.drain(0.05)
    while listener.inbox:
        listener.inbox.popleft()()
        listener.times.append(time.monotonic())


def test_a_run_that_was_stopped_is_played_to_nobody_up_to_its_last_commit(ros_domain, tmp_path):
    records = uniform()
    longer = SETTINGS.changed({'method': 'uniform', 'evaluate_every': 0, 'steps': 10**6})
    bag = ours(tmp_path / 'bag', [run(longer), *records[1:]])
    with player(bag, '--to', 'nobody', '--rate', '1000') as node:
        said = output(node)
    assert node.returncode == 0, said
    assert 'played 3 of 3 phases' in said


def as_played(records):
    """These records as live nodes get them: each commit has the digests of what it names."""
    chain = Chain(SETTINGS.lag)
    for record in records:
        chain.note(record)
        played = chain.completed(record) if isinstance(record, Commit) else record
        if isinstance(played, Commit):
            chain.follow(played)
        yield played


@pytest.mark.slow
def test_to_nobody_a_bag_goes_out_at_the_pace_at_which_it_was_recorded(listener, tmp_path):
    records = uniform()
    # steps begin when everybody has long discovered the topics, and take 6 s
    later = np.linspace(16e9, 22e9, len(records) - 2).astype(int)
    times = [0, 1, *later.tolist()]
    topics = [BagTopic(topic_of(r), type_name(type(r)), 10, False) for r in records]
    writer = McapWriter(tmp_path / 'bag', topics)
    for record, when in zip(records, times, strict=True):
        writer.write(topic_of(record), encode(record, 0), when)
    writer.close()
    with player(tmp_path / 'bag', '--to', 'nobody', '--rate', '2') as node:
        while node.poll() is None:
            hear(listener)
        said = output(node)
    sent = [record for record in as_played(records) if isinstance(record, HEARD)]
    end = time.monotonic() + 120
    while len(listener.heard) < len(sent) and time.monotonic() < end:
        hear(listener)  # what was under way when the player ended
    assert node.returncode == 0, said
    for kind in HEARD:
        due = [record for record in sent if isinstance(record, kind)]
        got = [record for record in listener.heard if isinstance(record, kind)]
        assert len(due) == len(got) and all(map(same, due, got)), TOPICS[kind]
    # at twice the pace, from the first steps on: the announcement is heard at any time before
    assert 2.5 < listener.times[-1] - listener.times[1] < 60
