"""Commits are completed by what was noted, and compared with it."""

from dataclasses import replace

import numpy as np
import pytest

from codetr_ros.records import CompositeReward, Preference, Transitions
from codetr_ros.records.chain import Chain, states_digests
from codetr_ros.records.digests import digest, digest_of_all
from helpers.builders import commit, policy, score, step_rewards, transitions

STEPS = [transitions(sequence=n, first_step=5 * n) for n in range(3)]
SCORES = [score(sequence=n, first_step=7 * n) for n in range(2)]
LABELS = [step_rewards(phase=0, part=n, parts=2) for n in range(2)]


def noted(*records, lag=1):
    chain = Chain(lag)
    for record in records:
        chain.note(record)
    return chain


def named(phase, steps, scores):
    return commit(
        phase=phase, transitions=np.array([steps], np.int64), scores=np.array([scores], np.int64)
    )


def test_a_commit_has_the_digests_of_what_it_names_and_of_the_commit_before():
    chain = noted(*STEPS, *reversed(SCORES), policy())
    first = chain.completed(named(0, 1, 0))
    assert first.transition_digests == (digest_of_all(STEPS[:2]),)
    assert first.score_digests == (digest_of_all(SCORES[:1]),)
    assert (first.policy_digest, first.previous) == (digest(policy()), '')
    assert (first.labels_digest, first.kept_labels_digest) == ('', '')
    chain.follow(first)
    for part in LABELS:
        chain.note(part, replace(part, labels=part.labels[:0]) if part.part else None)
    second = chain.completed(named(1, 2, 1))
    assert second.transition_digests == (digest_of_all(STEPS[2:]),)
    assert second.score_digests == (digest_of_all(SCORES[1:]),)
    assert second.labels_digest == digest_of_all(LABELS) != second.kept_labels_digest
    assert (second.policy_digest, second.previous) == ('', digest(first))


def test_nothing_new_has_a_digest_too_and_what_is_lacking_has_none():
    chain = noted(*STEPS[:1], *STEPS[2:])
    assert chain.completed(named(0, 0, -1)).score_digests == (digest_of_all([]),)
    assert chain.completed(named(0, 2, 0)).transition_digests == ('',)


def test_labels_are_named_once_all_parts_are_there_and_at_a_free_pace_never():
    chain = noted(LABELS[1])
    assert chain.labels(0) == ('', '')
    chain.note(LABELS[0])
    assert chain.labels(0) == (digest_of_all(LABELS),) * 2
    assert noted(*LABELS, lag=2).completed(named(1, -1, -1)).labels_digest == ''
    assert noted(*LABELS, lag=None).completed(named(1, -1, -1)).labels_digest == ''


def test_preferences_have_their_place_among_the_scores():
    preference = Preference(
        run_id='run', scorer='sim', sequence=1, source='sim', episode=0, first_step=0, length=7,
        other_source='sim', other_episode=0, other_first_step=7, other_length=7, outcome=1.0,
    )  # fmt: skip
    chain = noted(preference, SCORES[0])
    assert chain.completed(named(0, -1, 1)).score_digests == (
        digest_of_all([SCORES[0], preference]),
    )


WRONG = {
    "the transitions of 'sim' (numbers: 0 to 1)": {'transition_digests': ('0',)},
    "the composite rewards of 'sim' (numbers: 0 to 0)": {'score_digests': ('0',)},
    'the policy of phase 0': {'policy_digest': '0'},
    'the commit of phase -1': {'previous': '0'},
}


@pytest.mark.parametrize('said', WRONG)
def test_what_a_commit_states_otherwise_is_named(said):
    chain = noted(*STEPS, *SCORES, policy())
    sound = chain.completed(named(0, 1, 0))
    assert list(chain.differences(sound)) == []
    assert list(chain.differences(replace(sound, **WRONG[said]))) == [said]


def test_labels_may_be_those_that_were_published_or_those_that_were_kept():
    chain = noted(*LABELS)
    made = chain.completed(named(1, -1, -1))
    assert list(chain.differences(replace(made, labels_digest='0'))) == []
    wrong = replace(made, labels_digest='0', kept_labels_digest='1')
    assert list(chain.differences(wrong)) == ['the labels of phase 0']


def test_a_commit_of_protocol_1_is_compared_with_nothing():
    chain = noted(*STEPS)
    old = named(0, 1, -1)
    assert not states_digests(old) and list(chain.differences(old)) == []
    chain.follow(old)
    assert chain.next[Transitions, 'sim'] == 2 and chain.next[CompositeReward, 'sim'] == 0
