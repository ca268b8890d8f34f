"""Which announced run a node joins, and why it refuses another."""

from dataclasses import replace

import pytest

from codetr_ros.nodes.announced_run import SecondRunError, is_new
from codetr_ros.records import RecordError
from helpers.builders import run, tiny

RUN = run(tiny(), 'one')
OTHER = run(tiny(steps=2 * tiny().steps), 'one')
BROKEN = replace(run(tiny()), settings='{}')


def test_the_first_run_is_joined_and_its_learner_may_announce_it_again():
    assert is_new(RUN, None, '', '/r/sim')
    assert is_new(RUN, None, 'one', '/r/sim')
    assert not is_new(RUN, RUN, 'one', '/r/sim')


@pytest.mark.parametrize(
    ('spec', 'own', 'wanted', 'reason'),
    [
        (OTHER, RUN, '', "'one' is announced again with other settings: stop the second learner"),
        (replace(RUN, seed=7), RUN, '', 'announced again with other settings'),
        (replace(RUN, protocol_version=1), None, '', 'protocol_version 1, /r/sim speaks'),
        (replace(RUN, settings_hash='0'), None, '', "settings_hash '0' is not that of its sett"),
        (BROKEN, None, '', 'is not that of its settings: install the same version'),
        (RUN, None, 'two', r"was started for \(parameter run_id = 'two'\): leave run_id out"),
    ],
)
def test_another_one_is_refused_by_name(spec, own, wanted, reason):
    with pytest.raises(RecordError, match=reason) as refused:
        is_new(spec, own, wanted, '/r/sim')
    assert not isinstance(refused.value, SecondRunError)


def test_a_second_run_in_the_namespace_is_told_from_what_cannot_be_joined():
    with pytest.raises(SecondRunError, match="'two' beside 'one'. Stop one of them"):
        is_new(run(tiny(), 'two'), RUN, '', '/r/sim')
