"""What was published and did not arrive: asked for again, counted, and not waited for in vain."""

import json
from collections import Counter

import numpy as np
import pytest
from codetr_msgs.srv import FetchPhase
from diagnostic_msgs.msg import DiagnosticArray
from rosbags.highlevel import AnyReader

from codetr_ros.bags.definitions import decode
from codetr_ros.nodes.outbox import Outbox
from codetr_ros.records import (
    Commit,
    CompositeReward,
    Policy,
    RecordError,
    Transitions,
    TrueRewards,
)
from codetr_ros.ros.fetch import unpack
from codetr_ros.ros.membership import Membership
from codetr_ros.ros.resend import serve_outbox
from codetr_ros.ros.signals import Stop
from codetr_ros.runs import folder as run_folder
from helpers.builders import policy, score, step_rewards, task_spec, tiny, transitions
from helpers.commits import chunk, committed
from helpers.playing import NAMESPACE, everybody_matched, output, process


def settings():
    """One phase, which is labelled without being learnt from."""
    return tiny(steps=5, phase_steps=5, warmup_steps=5, evaluate_every=0, method='uniform')


def read_by(play, *nodes):
    """Whether these nodes read what the test publishes for simulators."""
    topics = ['transitions', 'composite_rewards', 'task']
    names = {f'{NAMESPACE}/{node}' for node in nodes}
    return not play.links['sim'].unmatched(topics, lambda _: names, readers=True)


def waits_for_a_phase(play):
    """Whether the reward node has joined, and lacks the first records of the run."""
    return any('the tasks of all sources' in p.doing for p in play.presence_of('reward'))


def publish_a_phase(play):
    """Publish all that a phase has; returns what its commit has digests of."""
    sim, learner = play.links['sim'], play.links['learner']
    named = (
        policy(steps=np.array([5], np.uint32)),
        transitions(phase_end=True, scores_due=1, terminated=True),
        score(length=5),
    )
    sim.publish(task_spec())
    learner.publish(named[0])
    for record in named[1:]:
        sim.publish(record)
    return named


def finishes(play, deaf, folder):
    """Let a reward node that something does not reach finish its only phase, beside a recorder;
    what it logs, and its report.
    """
    with (
        process('record') as record,
        process(deaf, f'folder:={folder}', 'peer_deadline:=180.0') as node,
    ):
        play.until(lambda: read_by(play, 'record', 'reward') and waits_for_a_phase(play), node)
        publish_a_phase(play)
        labels = play.until(lambda: play.messages('StepRewards', 'learner'), node)[0]
        assert list(labels.lengths) == [5]
        play.until(lambda: [p for p in play.presence_of('reward') if p.finished])
        play.finished = True
        play.until(lambda: node.poll() is not None and record.poll() is not None)
        said = output(node)
    assert node.returncode == 0, said
    return said, json.loads(run_folder.report_path(folder, 'reward', 'reward').read_text())


@pytest.mark.slow
def test_a_phase_that_a_node_lacks_is_fetched_from_the_recorder_and_the_loss_is_excused(
    play, tmp_path
):
    play = play(settings=settings(), roles=('learner', 'sim'))
    said, report = finishes(play, 'deaf', tmp_path)
    assert 'phase 0 is incomplete: asking the recorder for it' in said
    assert report['fetched'] == {'transitions': 1}
    assert report['lost'] == {}
    again = report['duplicated']  # with each answer: a slow recorder is asked more than once
    assert again['composite_rewards'] == again['commits'] >= 1
    missed = [presence.missed for presence in play.presence_of('reward')]
    assert missed[-1] == 0


@pytest.mark.slow
def test_a_commit_that_was_lost_is_asked_for_though_none_follows(play, tmp_path):
    play = play(settings=settings(), roles=('learner', 'sim'))
    said, report = finishes(play, 'uncommitted', tmp_path)
    assert 'the commit of phase 0 was lost: it came again' in said
    assert report['lost'] == {}


@pytest.mark.slow
def test_what_a_source_has_announced_is_asked_for_if_it_was_lost(play, tmp_path):
    play = play(settings=settings(), roles=('learner', 'sim'))
    outbox = Outbox(phase_steps=5, phases=1)
    serve_outbox(play.links['sim'], 'run', outbox)
    outbox.keep(task_spec(), stamp=1)
    for record in (transitions(phase=1, sequence=1), transitions(phase=2, sequence=2)):
        outbox.keep(record, stamp=2)  # of later phases: what was announced is not among the newest
    said, report = finishes(play, 'unannounced', tmp_path)
    assert 'what a source has announced had not arrived: it came again' in said
    assert report['lost'] == report['duplicated'] == {}
    assert report['fetched'] == {'task': 1}


@pytest.mark.slow
def test_permission_for_a_phase_is_asked_for_if_it_was_lost(play, tmp_path):
    play = play(settings=settings(), roles=('learner', 'record', 'reward'))
    learner = play.links['learner']
    outbox = Outbox(phase_steps=5, phases=3)
    serve_outbox(learner, 'run', outbox)
    with process('unpermitted', f'folder:={tmp_path}', 'peer_deadline:=180.0') as node:
        play.until(lambda: play.messages('TaskSpec', 'record'), node)
        for record in (
            policy(steps=np.array([5], np.uint32)),
            policy(phase=1, version=0, steps=np.array([0], np.uint32)),
        ):
            outbox.keep(record, learner.publish(record))
        play.until(lambda: play.presence_of('sim')[-1].finished)
        play.finished = True
        play.until(lambda: node.poll() is not None)
        said = output(node)
    assert node.returncode == 0, said
    assert 'permission for phase 0 had not arrived: it came again' in said
    assert [m.phase_end for m in play.messages('Transitions', 'record')] == [True]
    report = json.loads(run_folder.report_path(tmp_path, 'sim', 'sim').read_text())
    assert report['lost'] == report['duplicated'] == {}
    assert report['fetched'] == {'policy': 2}


@pytest.mark.slow
def test_what_was_lost_of_an_early_phase_is_asked_for_though_later_ones_are_whole(play, tmp_path):
    """A network that was cut: what no commit names, such as true rewards, is noticed late."""
    phases = 6
    play = play(settings=tiny(steps=30, phase_steps=5, warmup_steps=30, evaluate_every=0))
    sim, learner = play.links['sim'], play.links['learner']
    outbox = Outbox(phase_steps=5, phases=None)
    serve_outbox(sim, 'run', outbox)
    with process('record', f'folder:={tmp_path}', 'peer_deadline:=180.0') as node:
        play.until(lambda: everybody_matched(play), node)
        sim.publish(task_spec())
        for phase in range(phases):
            learner.publish(policy(phase=phase, steps=np.array([5], np.uint32)))
            rewards = np.arange(5, dtype=np.float32)
            steps = chunk(phase)
            true = TrueRewards(
                run_id='run', source='sim', sequence=phase, phase=phase, episode=0,
                first_step=steps.first_step, rewards=rewards,
            )  # fmt: skip
            outbox.keep(steps, sim.publish(steps))
            # those of the first phase do not arrive
            outbox.keep(true, sim.publish(true) if phase else 1)
            play.until(lambda n=phase: len(play.messages('Commit', 'learner')) > n, node)
        play.claimed = {'true_rewards': 1}
        play.finished = True
        play.until(lambda: node.poll() is not None)
        said = output(node)
    assert node.returncode == 0, said
    assert '1 messages of /r/sim had not arrived: it has sent them again' in said
    report = json.loads(run_folder.report_path(tmp_path, 'record', 'record').read_text())
    assert report['recorded']['true_rewards'] == phases
    assert report['fetched'] == {'true_rewards': 1}


def test_what_is_refused_while_a_node_stays_for_the_recorder_is_in_its_report(play, tmp_path):
    play = play(settings=settings(), roles=('learner', 'sim'))
    sim, heard = play.links['sim'], []
    sim.node.create_subscription(DiagnosticArray, '/diagnostics', heard.append, 10)

    def refused():
        of = [s for array in heard for s in array.status if s.hardware_id == 'reward']
        return of and {v.key: v.value for v in of[-1].values}.get('refused transitions')

    with process('record') as record, process('reward', f'folder:={tmp_path}') as node:
        play.until(lambda: read_by(play, 'record', 'reward') and waits_for_a_phase(play), node)
        publish_a_phase(play)
        # it has finished and written its report; the recorder waits for the others
        play.until(lambda: [p for p in play.presence_of('reward') if p.finished], node)
        play.claimed = {'transitions': -1}  # that is not of this run
        sim.publish(transitions(run_id='another'))
        assert play.until(refused, node) == '1'
        play.finished = True
        play.until(lambda: node.poll() is not None and record.poll() is not None)
        said = output(node)
    assert node.returncode == 0, said
    report = json.loads(run_folder.report_path(tmp_path, 'reward', 'reward').read_text())
    assert report['refused'] == {'transitions': 1}
    assert report['finished']


def test_a_node_gives_up_on_what_was_lost_for_good_naming_topic_and_count(play):
    play = play(settings=settings(), roles=('learner', 'sim', 'record'))
    with process('deaf', 'peer_deadline:=7.0') as deaf:  # and nobody offers to send anything again
        play.until(lambda: read_by(play, 'reward') and waits_for_a_phase(play), deaf)
        play.links['record'].publish(committed(*publish_a_phase(play)))
        play.until(lambda: deaf.poll() is not None)
        said = output(deaf)
    assert deaf.returncode == 1
    assert "messages that were published never reached it: 1 of 'transitions'" in said
    assert 'Traceback' not in said
    assert max(presence.missed for presence in play.presence_of('reward')) == 1


@pytest.mark.parametrize(
    ('waiting', 'deadline', 'lost'),
    [(61.0, 60.0, {}), (59.0, 60.0, {'commits': 1}), (1e6, 0.0, {'commits': 1})],
    ids=['nothing is lost', 'it may still come', 'for ever'],
)
def test_waiting_is_not_pointless_as_long_as(member, waiting, deadline, lost):
    member.values['peer_deadline'] = deadline
    member.patience(['commits']).check(1e6, waiting, 'waits', lost, {})


REFUSED = (9,)


class Core:
    """A core that has seen some trouble."""

    subscribes = (Transitions,)
    finished = False
    missing = None
    due = None

    def __init__(self):
        self.duplicated = Counter(transitions=2)
        self.refused = Counter(composite_rewards=3)

    def receive(self, record):
        if record.sequence in REFUSED:
            raise RecordError('no')
        self.duplicated['transitions'] += record.sequence == 0


@pytest.fixture
def member(play):
    """A node with such a core."""
    play(roles=())
    made = Membership('reward', 'reward', Stop())
    made.link.advertise(['presence'])
    made.serve(Core())
    yield made
    made.close()


def test_diagnostics_tell_what_the_core_has_dropped_and_refused_later(member, play):
    witness = play(roles=('sim',))
    heard = []
    witness.links['sim'].node.create_subscription(
        DiagnosticArray, '/diagnostics', heard.append, 10
    )
    member.traffic.refuse(Transitions, RecordError('wrong'))

    def said():
        member.publish_presence()
        return [s for a in heard for s in a.status if s.name == f'{NAMESPACE}/reward: messages']

    status = witness.until(said)[0]
    values = {value.key: value.value for value in status.values}
    assert values['duplicated transitions'] == '2'
    assert values['refused composite_rewards'] == '3'
    assert values['refused transitions'] == '1'
    assert status.level == b'\x01'


def test_what_came_and_was_refused_is_not_lost(member, play):
    play = play(roles=('sim',))
    sim = play.links['sim']
    for record in (play.presence_now('sim'), transitions(sequence=9)):
        member.take(type(record), sim.message(record))
    assert member.traffic.refused == {'transitions': 1}
    assert member.traffic.received == {'transitions': 1}


def test_what_is_fetched_counts_as_recovered_only_if_it_was_new_and_taken(member):
    for record in (transitions(sequence=0), transitions(sequence=9), transitions(sequence=4)):
        member.traffic.receive_again(record)
    assert member.traffic.recovered == {'transitions': 1}


@pytest.mark.parametrize(('kinds', 'clients'), [((Transitions, Commit), 1), ((Policy,), 0)])
def test_only_a_node_that_takes_phases_in_asks_for_them_again(play, kinds, clients):
    play = play(roles=())
    member = Membership('reward', 'reward', Stop())
    member.run = play.spec
    core = Core()
    core.subscribes = kinds
    member.serve(core)
    assert [c.srv_name for c in member.link.node.clients] == ['fetch_phase'] * clients
    member.close()


def test_what_the_core_has_not_taken_is_not_sent_again(play, tmp_path):
    play = play()
    with process('record', f'folder:={tmp_path}') as node:
        play.until(lambda: everybody_matched(play), node)
        sim = play.links['sim']
        heard = []
        sim.node.create_subscription(DiagnosticArray, '/diagnostics', heard.append, 10)
        sim.publish(task_spec())
        play.links['learner'].publish(policy(steps=np.array([5], np.uint32)))
        sim.publish(transitions(phase_end=True, scores_due=1))
        sim.publish(transitions(observations=np.full((6, 3), np.nan, np.float32)))
        sim.publish(transitions(sequence=3))
        sim.publish(transitions(run_id='another'))
        play.links['reward'].publish(step_rewards(run_id='another'))
        # two are not of this run; and number 3 is waited for as long as it counts as published
        play.claimed = {'transitions': -2, 'step_rewards': -1}
        refused = [('refused step_rewards', '1'), ('refused transitions', '2')]
        play.until(
            lambda: any(
                [(v.key, v.value) for v in s.values if v.key.startswith('refused')] == refused
                for a in heard
                for s in a.status
                if s.hardware_id == 'record'
            )
        )
        sim.publish(score(length=5))
        play.until(lambda: play.messages('Commit', 'learner'))
        client = play.links['learner'].node.create_client(FetchPhase, 'fetch_phase')
        play.until(client.service_is_ready)
        future = client.call_async(FetchPhase.Request(run_id='run', phase=0))
        play.until(future.done)
        sent = [decode(kind, data) for kind, data in unpack(future.result())]
        play.finished = True
        play.until(lambda: node.poll() is not None)
        said = output(node)
    assert node.returncode == 0, said
    # topics may overtake each other, but the commit is the last
    kinds = [type(record) for record in sent]
    assert Counter(kinds) == Counter([Policy, Transitions, CompositeReward, Commit])
    assert kinds[-1] is Commit
    assert np.isfinite(sent[kinds.index(Transitions)].observations).all()
    with AnyReader([tmp_path / 'bag']) as bag:
        runs = {bag.deserialize(raw, c.msgtype).run_id for c, _, raw in bag.messages()}
    assert runs == {'run'}
    report = json.loads(run_folder.report_path(tmp_path, 'record', 'record').read_text())
    assert report['refused'] == {'transitions': 2, 'step_rewards': 1}
    assert report['recorded']['transitions'] == 1  # only what is sound
    assert 'step_rewards' not in report['recorded']
