"""`codetr label`: the old bag byte for byte, and a label for every step that a score covers."""

import numpy as np
import pytest
import torch

from codetr_ros import cli
from codetr_ros.bags.definitions import encode
from codetr_ros.bags.reader import Bag
from codetr_ros.bags.topics import BagTopic
from codetr_ros.bags.verify import verify
from codetr_ros.bags.writer import McapWriter
from codetr_ros.records import TOPICS, CompositeReward, RunSpec, StepRewards, TaskSpec, Transitions
from codetr_ros.records.fields import type_name
from codetr_ros.runs import checkpoints
from helpers.builders import score, transitions
from helpers.foreign_bags import message, write, write_messages
from helpers.saved import trained


@pytest.fixture(scope='module')
def fitted(a_run, tmp_path_factory):
    out = tmp_path_factory.mktemp('fit') / 'out'
    flags = ['--gradient-steps=20', '--check-every=10']
    assert cli.main(['fit', str(a_run.bag), '--out', str(out), *flags]) == 0
    return out


def label(bag, checkpoint, out, *flags, code=0):
    given = ['label', str(bag), '--checkpoint', str(checkpoint), '--out', str(out), *flags]
    assert cli.main(given) == code
    return out


def raw(bag):
    return [(m.channel.topic, m.log_time, m.publish_time, bytes(m.data)) for m in Bag(bag).raw()]


def labels(bag):
    """Labels by source, episode and step; later ones hold."""
    found = {}
    for entry in Bag(bag).entries((StepRewards,)):
        record = entry.record
        at = 0
        for episode, first, length in zip(
            record.episodes, record.first_steps, record.lengths, strict=True
        ):
            for i in range(length):
                found[record.run_id, record.source, int(episode), int(first) + i] = float(
                    record.labels[at + i]
                )
            at += length
    return found


def test_all_of_the_old_bag_is_in_the_new_one_and_every_scored_step_is_labelled(
    a_run, fitted, tmp_path, capsys
):
    bare = [r for r in a_run.records if not isinstance(r, StepRewards)]
    old = write(tmp_path / 'old', bare)

    new = label(old, fitted, tmp_path / 'new')

    before = raw(old)
    assert raw(new)[: len(before)] == before
    scored = {
        ('calls', r.source, r.episode, r.first_step + i)
        for r in bare
        if isinstance(r, CompositeReward)
        for i in range(r.length)
    }
    assert labels(new).keys() == scored
    assert np.isfinite(list(labels(new).values())).all()
    assert verify(new).report()['findings'] == verify(old).report()['findings']
    said = capsys.readouterr().out
    assert f'{len(scored)} steps, on /run_calls/step_rewards' in said
    assert f'not labelled    {1000 - len(scored)} steps that no score covers' in said


def test_the_labels_of_the_runs_own_last_model_are_those_that_the_run_ended_with(a_run, tmp_path):
    """The run's model, applied afterwards, says what it said in the run's last phase."""
    out = tmp_path / 'fold'
    given = ['fit', str(a_run.bag), '--out', str(out), '--schedule', 'phases']
    assert cli.main(given) == 0
    newest = max(r.phase for r in a_run.records if isinstance(r, StepRewards))
    mine = [r for r in a_run.records if isinstance(r, StepRewards) and r.phase == newest]
    bag = write(tmp_path / 'last', mine)
    last = labels(bag)

    new = labels(label(a_run.bag, out, tmp_path / 'new'))

    shared = last.keys() & new.keys()
    assert shared == last.keys()
    assert len(shared) > 400
    assert [new[k] for k in shared] == pytest.approx([last[k] for k in shared], rel=1e-4, abs=1e-5)


def test_labels_that_a_run_has_recorded_are_succeeded_by_the_new_ones(a_run, fitted, tmp_path):
    new = label(a_run.bag, fitted, tmp_path / 'new')

    recorded = sum(isinstance(r, StepRewards) for r in a_run.records)
    found = [entry.record for entry in Bag(new).entries((StepRewards,))]
    assert min(r.phase for r in found[recorded:]) == a_run.settings.phases
    assert max(r.phase for r in found[:recorded]) < a_run.settings.phases
    assert [r.part for r in found[recorded:]] == list(range(found[-1].parts))


def test_labels_do_not_depend_on_how_much_is_held_in_memory(a_run, fitted, tmp_path):
    whole = labels(label(a_run.bag, fitted, tmp_path / 'whole'))
    parts = labels(label(a_run.bag, fitted, tmp_path / 'parts', '--memory-steps', '60'))
    assert parts == pytest.approx(whole, rel=1e-4, abs=1e-5)


def test_what_others_recorded_in_the_same_bag_stays_as_it_was(fitted, a_run, tmp_path):
    """Topics of types that this project does not know keep their bytes and their definitions."""
    data = [r for r in a_run.records if isinstance(r, Transitions | CompositeReward)]

    def joint_state(store):
        header = store.types['std_msgs/msg/Header'](
            store.types['builtin_interfaces/msg/Time'](3, 4), 'base'
        )
        one = np.array([1.5])
        return store.types['sensor_msgs/msg/JointState'](header, ['elbow'], one, one, one)

    made = [(f'/r/{type(r).__name__}', lambda store, r=r: message(store, r)) for r in data]
    old = write_messages(tmp_path / 'old', [*made, ('/joint_states', joint_state)])

    new = label(old, fitted, tmp_path / 'new')

    (found,) = Bag(new).messages(topics=['/joint_states'])
    assert found.message.name == ['elbow']
    assert raw(new)[: len(raw(old))] == raw(old)


def test_a_model_of_other_sizes_is_refused_and_what_cannot_be_labelled_is_counted(
    a_run, fitted, tmp_path, capsys
):
    small = [transitions(steps=7), transitions(steps=7, episode=1, sequence=1), score()]
    bag = write(tmp_path / 'bag', small)
    label(bag, fitted, tmp_path / 'no', code=1)
    assert 'has observation_size = 10, here 3' in capsys.readouterr().err

    trained(tmp_path / 'checkpoints')
    late = [score(sequence=1, episode=1), score(sequence=2, episode=9)]
    bag = write(tmp_path / 'late', [*small, *late[1:]])
    new = label(bag, checkpoints.latest(tmp_path / 'checkpoints', 'reward'), tmp_path / 'yes')
    assert len(labels(new)) == 7
    said = capsys.readouterr().out
    assert 'not labelled    7 steps that no score covers' in said
    assert '1 scores of steps that are not all there' in said


def test_an_existing_bag_is_not_written_to(a_run, fitted, tmp_path, capsys):
    label(a_run.bag, fitted, a_run.bag, code=2)
    assert 'exists and holds' in capsys.readouterr().err
    label(a_run.bag, tmp_path, tmp_path / 'new', code=2)
    assert 'is no checkpoint' in capsys.readouterr().err


def test_a_bag_without_scores_has_nothing_to_label(fitted, a_run, tmp_path, capsys):
    keep = (RunSpec, TaskSpec, Transitions)
    bag = write(tmp_path / 'bag', [r for r in a_run.records if isinstance(r, keep)])
    label(bag, fitted, tmp_path / 'new', code=2)
    assert 'but no CompositeReward' in capsys.readouterr().err


def test_labels_number_on_where_the_recorders_own_have_a_gap(a_run, fitted, tmp_path):
    topics = [
        BagTopic(f'/run/{name}', type_name(kind), 10, False) for kind, name in TOPICS.items()
    ]
    writer = McapWriter(tmp_path / 'old', topics)
    for i, record in enumerate(a_run.records):
        name = f'/run/{TOPICS[type(record)]}'
        writer.counts[name] += isinstance(record, StepRewards) and record.phase == 3
        writer.write(name, encode(record), 1000 + i)
    writer.close()
    before = verify(tmp_path / 'old').findings.counts
    assert before['gap'], 'numbers of step_rewards are missing'
    new = label(tmp_path / 'old', fitted, tmp_path / 'new')
    assert verify(new).findings.counts == before


def test_times_that_a_message_cannot_say_are_refused_by_name(a_run, fitted, tmp_path, capsys):
    old = write_messages(
        tmp_path / 'old',
        ((f'/run/{TOPICS[type(r)]}', lambda store, r=r: message(store, r), 2**62)
         for r in a_run.records),
    )  # fmt: skip
    label(old, fitted, tmp_path / 'new', code=2)
    assert 'StepRewards cannot be written' in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ['old'], 'nothing unfinished is left'


@pytest.mark.skipif(torch.cuda.is_available(), reason='there is a GPU here')
def test_a_device_that_is_not_here_is_said_and_nothing_is_written(a_run, fitted, tmp_path, capsys):
    new = label(a_run.bag, fitted, tmp_path / 'new', '--reward-device=cuda', code=1)
    assert 'reward_device=cuda: torch' in capsys.readouterr().err
    assert not new.exists()
