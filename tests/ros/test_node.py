"""Nodes as processes, among peers that this test plays itself over real topics."""

import json
import signal
import time

import numpy as np
import pytest
from codetr_msgs.srv import FetchPhase
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.parameter import Parameter
from rosbags.highlevel import AnyReader

from codetr_ros.bags.definitions import decode
from codetr_ros.records import PROTOCOL_VERSION, Commit, RunSpec
from codetr_ros.records.digests import digest
from codetr_ros.records.roles import command
from codetr_ros.ros.watch import Watcher
from codetr_ros.runs import folder as run_folder
from helpers.builders import step_rewards, task_spec, transitions
from helpers.playing import NAMESPACE, PATIENCE, everybody_matched, one_phase, output, process


def test_a_recorder_commits_a_phase_and_keeps_every_byte_of_it(play, tmp_path):
    play = play()
    with process('record', f'folder:={tmp_path}', 'peer_deadline:=180.0') as node:
        play.until(lambda: everybody_matched(play), node)
        commit = one_phase(play)
        assert (commit.phase, list(commit.sources), list(commit.transitions)) == (0, ['sim'], [0])
        labels = np.arange(5, dtype=np.float32)
        play.links['reward'].publish(step_rewards(commit=digest(commit)))
        play.finished = True
        play.until(lambda: node.poll() is not None)
        said = output(node)
    assert node.returncode == 0, said
    assert 'Traceback' not in said
    with AnyReader([tmp_path / 'bag']) as bag:
        read = {c.topic: bag.deserialize(raw, c.msgtype) for c, _, raw in bag.messages()}
        counts = {c.topic: c.msgcount for c in bag.connections if c.msgcount}
    assert read['/r/transitions'].observations.tobytes() == transitions().observations.tobytes()
    assert read['/r/step_rewards'].labels.tobytes() == labels.tobytes()
    report = json.loads(run_folder.report_path(tmp_path, 'record', 'record').read_text())
    assert report['recorded'] == {topic.removeprefix('/r/'): n for topic, n in counts.items()}
    assert report['recorded'] == {
        'run': 1, 'task': 1, 'policy': 1, 'transitions': 1, 'composite_rewards': 1,
        'step_rewards': 1, 'commits': 1, 'metrics': 1,
    }  # fmt: skip
    assert report['lost'] == {}
    assert report['finished']


@pytest.mark.slow
def test_what_was_published_and_never_came_is_reported_as_lost(play, tmp_path):
    play = play()
    with process('record', f'folder:={tmp_path}', 'peer_deadline:=8.0') as node:
        play.until(lambda: everybody_matched(play), node)
        one_phase(play)
        play.claimed = {'step_rewards': 2}
        play.finished = True
        play.say()
        said = output(node)
    assert 'gave up after 8 s: waits for the end of nobody and for 2 of step_rewards' in said
    report = json.loads(run_folder.report_path(tmp_path, 'record', 'record').read_text())
    assert report['lost'] == {'step_rewards': 2}


def test_a_committed_phase_is_sent_again_and_another_refused_with_the_reason(play):
    play = play()
    with process('record') as node:
        play.until(lambda: everybody_matched(play), node)
        one_phase(play)
        client = play.links['learner'].node.create_client(FetchPhase, 'fetch_phase')
        play.until(client.service_is_ready)

        def ask(**request):
            future = client.call_async(FetchPhase.Request(requester='/r/learner', **request))
            play.until(future.done)
            return future.result()

        from codetr_ros.ros.fetch import unpack

        sent = unpack(ask(run_id='run', phase=0))
        records = {kind.__name__: decode(kind, data) for kind, data in sent}
        assert set(records) == {'Transitions', 'CompositeReward', 'Commit'}
        again = records['Transitions'].observations
        assert again.tobytes() == transitions().observations.tobytes()
        begun = ask(run_id='run', phase=1)  # nothing has come of it yet
        assert (begun.found, begun.parts, len(begun.types)) == (True, 1, 0)
        assert ask(run_id='run', phase=2).reason == 'phase 2 is not in memory; these are: 0'
        assert "not 'other'" in ask(run_id='other', phase=0).reason
        node.send_signal(signal.SIGTERM)
        said = output(node)
    assert node.returncode == 0, said


def test_a_node_that_waits_publishes_for_whom_and_for_how_long(play):
    play = play(roles=('learner', 'reward'))
    with process('record') as node:

        def growing():
            times = [m.waiting for m in play.presence_of('record') if 'waits for sim' in m.doing]
            return times if times and times[-1] > 1 else None

        times = play.until(growing, node)
        assert times == sorted(times)
        node.send_signal(signal.SIGTERM)
        play.until(lambda: node.poll() is not None)
    assert play.presence_of('record')[-1].waiting == 0, 'who has ended waits for nobody'


def test_what_must_be_refused_is_counted_and_changes_nothing(play, tmp_path):
    play = play()
    with process('record', f'folder:={tmp_path}') as node:
        play.until(lambda: everybody_matched(play), node)
        play.links['sim'].publish(transitions(run_id='another'))
        play.claimed = {'transitions': -1}  # that is not of this run
        one_phase(play)
        diagnostics = []
        play.links['sim'].node.create_subscription(
            DiagnosticArray, '/diagnostics', diagnostics.append, 10
        )
        status = play.until(
            lambda: [s for a in diagnostics for s in a.status if s.name == '/r/record: messages']
        )[0]
        assert status.level == b'\x01'
        assert {v.key: v.value for v in status.values}['refused transitions'] == '1'
        play.finished = True
        play.until(lambda: node.poll() is not None)
        said = output(node)
    assert "of run 'another', this is run 'run'" in said
    assert node.returncode == 0


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM], ids=lambda s: s.name)
def test_a_signal_ends_a_waiting_node_at_once_without_traceback(play, number):
    play(roles=())
    took = [ended_by(number)]
    while min(took) >= 3.0 and len(took) < 3:  # the machine may have held it
        took.append(ended_by(number))
    assert min(took) < 3.0  # the interpreter's own end included


def ended_by(number):
    """Seconds in which a signal ends a node that waits."""
    watched = []
    with Watcher(watched.append, NAMESPACE) as watcher, process('record') as node:
        end = time.monotonic() + PATIENCE
        while not watched and time.monotonic() < end:
            watcher.poll(0.1)
        assert watched[0].role == 'record'
        assert watched[0].settings_hash == ''
        began = time.monotonic()
        node.send_signal(number)
        node.send_signal(number)  # a second one changes nothing
        said = output(node)
        seconds = time.monotonic() - began
        while not watched[-1].finished and time.monotonic() < end:
            watcher.poll(0.1)
    assert node.returncode == 0, said
    assert 'Traceback' not in said
    assert f'stopped by {number.name}' in said
    assert watched[-1].finished
    return seconds


def test_a_node_without_a_learner_names_it_and_gives_up(ros_domain):
    with process('record', 'peer_deadline:=0.5') as node:
        said = output(node)
    assert node.returncode == 1
    assert (
        "gave up after 0.5 s: it waits for the learner, which announces a run on '/r/run'" in said
    )
    assert f'start `{command("learner")}` in this namespace' in said
    assert 'Traceback' not in said


@pytest.mark.slow
def test_a_missing_role_is_named_with_what_starts_it(play):
    play = play(roles=('learner', 'sim'))
    with process('record', 'peer_deadline:=8.0') as node:
        play.until(lambda: node.poll() is not None)
        said = output(node)
    assert node.returncode == 1
    assert f'it waits for reward (start it with `{command("reward")}`' in said


def test_a_node_takes_its_settings_from_the_run_and_shows_them(play):
    play = play()
    with process('record', 'delay:=7') as node:
        play.until(lambda: any(p.settings_hash for p in play.presence_of('record')))
        client = play.links['sim'].node.create_client(GetParameters, '/r/record/get_parameters')
        play.until(client.service_is_ready)
        future = client.call_async(
            GetParameters.Request(names=['task', 'delay', 'sac.hidden', 'bag'])
        )
        play.until(future.done)
        task, delay, hidden, bag = future.result().values
        assert task.string_value == play.settings.task
        assert delay.integer_value == 7
        assert list(hidden.integer_array_value) == [16, 16]
        assert bag.string_value == ''
        setter = play.links['sim'].node.create_client(SetParameters, '/r/record/set_parameters')
        play.until(setter.service_is_ready)
        future = setter.call_async(
            SetParameters.Request(parameters=[Parameter('delay', value=8).to_parameter_msg()])
        )
        play.until(future.done)
        assert not future.result().results[0].successful
        node.terminate()
        assert node.wait(PATIENCE) == 0


def test_a_parameter_that_contradicts_the_run_stops_the_node_naming_both_values(play):
    play = play()
    with process('record', 'delay:=50') as node:
        play.until(lambda: node.poll() is not None)
        said = output(node)
    assert node.returncode == 1
    assert (
        'parameters contradict the run: delay = 50, but learner /r/learner has delay = 7' in said
    )


def test_an_unknown_parameter_stops_the_node_naming_it(ros_domain):
    with process('record', 'dealy:=50') as node:
        said = output(node)
    assert node.returncode == 1
    assert '/r/record has no parameter dealy=50' in said


@pytest.mark.slow
def test_a_checkpoint_that_is_not_there_stops_the_node_before_it_waits(ros_domain, tmp_path):
    with process('reward', f'checkpoint:={tmp_path / "none"}') as node:
        said = output(node)
    assert node.returncode == 1
    assert f"parameter checkpoint = '{tmp_path}/none': there is no such folder" in said
    assert 'Traceback' not in said


def test_another_protocol_version_is_refused(play):
    play = play(roles=('learner',))
    spec = play.spec
    other = RunSpec(
        run_id='other',
        protocol_version=PROTOCOL_VERSION + 1,
        seed=0,
        settings=spec.settings,
        settings_hash=spec.settings_hash,
    )
    play.links['learner'].publish(other)
    with process('record', 'run_id:=other', 'peer_deadline:=8.0') as node:
        play.until(lambda: node.poll() is not None)
        said = output(node)
    assert node.returncode == 1
    assert (
        f'speaks protocol_version {PROTOCOL_VERSION + 1}, /r/record speaks {PROTOCOL_VERSION}'
        in said
    )
    assert (
        "run 'run' is not the one that /r/record was started for (parameter run_id = 'other')"
        in said
    )


def test_two_nodes_of_one_name_are_refused(play):
    play = play(roles=('learner', 'sim'))
    with process('record', name='sim') as node:
        play.until(lambda: node.poll() is not None)
        said = output(node)
    assert node.returncode == 1
    assert 'two nodes are called /r/sim' in said


def test_a_second_learner_in_the_namespace_is_refused_naming_both_runs(play):
    play = play(roles=('learner',), run_id='first')
    with process('learner', 'run_id:=second', name='learner_2') as node:
        play.until(lambda: node.poll() is not None)
        said = output(node)
    assert node.returncode == 1
    assert "a second run in the namespace of /r/learner_2: 'first' beside 'second'" in said


@pytest.mark.slow
def test_a_peer_that_stops_before_the_run_is_over_is_named(play):
    play = play()
    with process('record', 'peer_deadline:=11.0') as node:
        play.until(lambda: everybody_matched(play), node)
        play.links['sim'].publish(task_spec())
        play.until(lambda: play.presence_of('record'))
        # nobody says anything from now on
        said = output(node)
    assert node.returncode == 1
    assert 'has been silent for' in said
    assert 'permission for phase 0 from the learner' in said
    assert '/r/learner' in said


def test_commits_are_heard_by_who_comes_late(play):
    play = play()
    with process('record') as node:
        play.until(lambda: everybody_matched(play), node)
        one_phase(play)
        heard = []
        with Watcher(heard.append, NAMESPACE) as watcher:
            end = time.monotonic() + PATIENCE
            while not any(isinstance(r, Commit) for r in heard) and time.monotonic() < end:
                watcher.poll(0.1)
        assert [r.phase for r in heard if isinstance(r, Commit)] == [0]
        node.terminate()
        assert node.wait(PATIENCE) == 0
