"""The recorder keeps the last phases, for nodes that lack some of them."""

import numpy as np

from codetr_ros.nodes.last_phases import LastPhases
from codetr_ros.records import Commit
from helpers.builders import commit, score, transitions


def test_the_last_phases_keep_what_a_commit_names_once():
    last = LastPhases(2)
    last.hold(transitions(), b'a')
    last.hold(score(), b'b')
    last.commit(commit(scores=np.zeros(1, np.int64)), b'c')
    assert [raw for _, raw in last.get(0)] == [b'a', b'b', b'c']
    last.commit(commit(phase=1), b'd')
    assert last.get(1) == [(Commit, b'd')]


def test_of_two_steps_of_the_same_number_the_first_is_sent_again():
    last = LastPhases(2)
    last.hold(transitions(), b'taken')
    last.hold(transitions(), b'refused later, once the source is announced')
    last.commit(commit(), b'commit')
    assert [raw for _, raw in last.get(0)] == [b'taken', b'commit']
