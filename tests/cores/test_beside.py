"""What a recorder takes that no commit names: late, but of no phase that nobody has permitted."""

import numpy as np
import pytest

from codetr_ros.cores.beside import Beside
from codetr_ros.cores.left_out import voided
from codetr_ros.records import RecordError, TrueRewards
from helpers.builders import commit, run, tiny

SETTINGS = tiny()


def true_rewards(sequence, phase):
    return TrueRewards(
        run_id='run',
        source='sim',
        sequence=sequence,
        phase=phase,
        episode=0,
        first_step=sequence,
        rewards=np.zeros(1, np.float32),
    )


def test_true_rewards_that_were_lost_are_taken_when_they_are_sent_again():
    beside = Beside(run(SETTINGS), SETTINGS, lambda: 4)
    for sequence in (0, 3, 4, 1, 2):
        beside.receive(true_rewards(sequence, 2))
    assert beside.duplicated == {}, 'they came late, and for the first time'
    for sequence in range(5):
        beside.receive(true_rewards(sequence, 2))
    assert beside.duplicated == {'true_rewards': 5}


def test_true_rewards_may_be_late_by_any_number_of_phases():
    beside = Beside(run(SETTINGS), SETTINGS, lambda: 4)
    for sequence, phase in ((0, 0), (1, 1), (2, 4)):
        beside.receive(true_rewards(sequence, phase))
    beside.receive(true_rewards(1, 1))
    assert beside.duplicated == {'true_rewards': 1}
    with pytest.raises(RecordError, match='phase must be from 0 to 5'):
        beside.receive(true_rewards(3, 6))


def test_true_rewards_are_taken_of_a_source_that_was_left_out_of_phases_one_after_the_other():
    """With overlap, two phases are permitted: each commit voids numbers of both."""
    settings = SETTINGS.changed({'overlap': True, 'simulators': 2})
    beside, due = Beside(run(settings), settings, lambda: 4), 1
    beside.receive(true_rewards(0, 0))
    for phase in (1, 2):
        last = voided(settings, due)
        beside.receive(commit(phase=phase, transitions=np.array([last]), dropped=('sim',)))
        due = last + 1
    with pytest.raises(RecordError, match='sequence must be from'):
        beside.receive(true_rewards(due + 1000, 4))
    for sequence in (due, 1):  # the second was under way when its source was left out
        beside.receive(true_rewards(sequence, 4))
    assert beside.duplicated == {}


def test_true_rewards_of_what_a_commit_names_are_lacking_until_they_come():
    beside = Beside(run(SETTINGS), SETTINGS, lambda: 0)
    named = commit(transitions=np.array([2]))
    assert not beside.lacks_true_rewards(named), 'a source may have none'
    for sequence in (0, 1):
        beside.receive(true_rewards(sequence, 0))
        assert beside.lacks_true_rewards(named)
    beside.receive(true_rewards(2, 0))
    assert not beside.lacks_true_rewards(named)
    assert not beside.lacks_true_rewards(commit(transitions=np.array([5]), dropped=('sim',)))
