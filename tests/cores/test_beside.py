"""What a recorder takes that no commit names: late, but of no phase that nobody has permitted."""

import numpy as np
import pytest

from codetr_ros.cores.beside import Beside
from codetr_ros.records import RecordError, TrueRewards
from helpers.builders import run, tiny

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
