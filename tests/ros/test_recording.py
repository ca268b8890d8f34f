"""The recorder node: what is committed is on the disk, and a full disk ends the run."""

import json
import os

import numpy as np
import pytest
from mcap.reader import make_reader

from codetr_ros.cores.recorder import Recorder
from codetr_ros.ros.joining import Joined
from codetr_ros.ros.membership import Membership
from codetr_ros.ros.recording import Recording
from codetr_ros.ros.signals import Stop
from codetr_ros.runs import folder as run_folder
from helpers.bag_writing import files, sequences
from helpers.builders import commit, policy, score, task_spec, transitions
from helpers.disks import fill, small_disk
from helpers.playing import everybody_matched, output, process


@pytest.fixture
def recorder(play, tmp_path):
    """The wiring of a recorder with its bag open, among no peers."""
    play = play(roles=())
    member = Membership('record', 'record', Stop())
    member.values = {
        'peer_deadline': 60.0,
        'bag': str(tmp_path / 'bag'),
        'bag_split_mb': 0.0,
        'bag_keep_free_mb': 0.0,
        'leave_out_after': 30.0,
    }
    member.announcement = member.link.message(play.spec)
    member.link.advertise(['run', 'commits'])
    core = Recorder(play.spec, play.settings, 'record')
    wiring = Recording(member, Joined(play.spec, play.settings, core, None))
    wiring.open()
    yield wiring
    member.close()


def test_a_commit_goes_out_when_it_and_all_before_it_are_on_the_disk(
    recorder, tmp_path, monkeypatch
):
    path = tmp_path / 'bag' / 'bag_0.mcap'
    happened = []
    fsync, send = os.fsync, recorder.member.link.send

    def watched_fsync(descriptor):
        fsync(descriptor)
        happened.append(('on the disk', os.fstat(descriptor).st_size))

    def watched_send(topic, message):
        happened.append((topic, path.stat().st_size))
        send(topic, message)

    monkeypatch.setattr(os, 'fsync', watched_fsync)
    monkeypatch.setattr(recorder.member.link, 'send', watched_send)
    recorder.deliver(commit())
    size = path.stat().st_size
    assert happened == [('on the disk', size), ('commits', size)]
    recorder.close()
    with path.open('rb') as file:
        topics = [channel.topic for _, channel, _ in make_reader(file).iter_messages()]
    assert topics == ['/r/run', '/r/commits']


def one_phase_on(disk, play, keep_free, leave):
    """What a recorder says that has a phase to record on a disk which is full by then."""
    parameters = f'bag:={disk / "run" / "bag"}', f'bag_keep_free_mb:={keep_free}'
    with process('record', *parameters, f'folder:={disk / "run"}') as node:
        play.until(lambda: everybody_matched(play), node)
        fill(disk, leave)
        sim, learner = play.links['sim'], play.links['learner']
        sim.publish(task_spec())
        learner.publish(policy(steps=np.array([5], np.uint32)))
        sim.publish(transitions(steps=5, phase_end=True, scores_due=1))
        sim.publish(score(length=5))
        play.until(lambda: node.poll() is not None)
        said = output(node)
    assert node.returncode == 1
    assert not play.messages('Commit')
    assert 'Traceback' not in said
    return said


def test_a_disk_that_runs_full_ends_the_run_while_the_bag_can_be_closed(play, tmp_path):
    with small_disk(tmp_path / 'disk', 8) as disk:
        said = one_phase_on(disk, play(), keep_free=1.0, leave=500_000)
        assert '/run/bag: the disk has 0.5 MB left, fewer than the 1.0 MB to be kept free' in said
        (path,) = files(disk / 'run' / 'bag')
        with path.open('rb') as file:
            recorded = [c.topic for _, c, _ in make_reader(file).iter_messages()]
        assert {'/r/transitions', '/r/composite_rewards'} <= set(recorded)
        assert '/r/commits' not in recorded
        assert (disk / 'run' / 'bag' / 'metadata.yaml').is_file()
        report = json.loads(run_folder.report_path(disk / 'run', 'record', 'record').read_text())
        assert 'fewer than the 1.0 MB' in report['error']


def test_a_disk_that_is_full_ends_the_run_with_an_error_that_says_so(play, tmp_path):
    with small_disk(tmp_path / 'disk', 8) as disk:
        said = one_phase_on(disk, play(), keep_free=0.0, leave=0)
        assert 'bag_0.mcap cannot be written: No space left on device' in said
        (path,) = files(disk / 'run' / 'bag')
        assert sequences(path) == []  # nothing was committed, and what there is can be read
