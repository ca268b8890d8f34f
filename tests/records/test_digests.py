"""A digest is of what a record means: of every field, and of nothing else."""

import hashlib
import struct
from dataclasses import fields, replace

import numpy as np
import pytest

from codetr_ros.records import (
    Commit,
    CompositeReward,
    Metrics,
    Policy,
    Preference,
    StepRewards,
    Transitions,
)
from codetr_ros.records.digests import digest, digest_of_all, raw_digest
from helpers.builders import commit, policy, score, step_rewards, transitions

PREFERENCE = Preference(
    run_id='run',
    scorer='me',
    sequence=4,
    source='sim',
    episode=1,
    first_step=2,
    length=3,
    other_source='sim',
    other_episode=4,
    other_first_step=5,
    other_length=6,
    outcome=0.5,
)
RECORDS = {
    Transitions: transitions(),
    CompositeReward: score(),
    Preference: PREFERENCE,
    Policy: policy(random=False, network='{}', weights=b'abc'),
    StepRewards: step_rewards(),
    Commit: commit(previous='ab'),
}


def number(value: int) -> bytes:
    return value.to_bytes(9, 'little', signed=True)


def text(value: str) -> bytes:
    return struct.pack('<Q', len(value.encode())) + value.encode()


def test_the_digest_of_a_score_is_the_sha256_of_its_fields_as_documented():
    record = score(source='söurce', scorer='me', sequence=2**63, value=-0.1)
    plain = b'CompositeReward\0' + text('söurce') + text('me')
    plain += number(2**63) + number(0) + number(0) + number(7) + struct.pack('<d', -0.1)
    assert digest(record) == hashlib.sha256(plain).hexdigest()


def test_the_digest_of_steps_is_the_sha256_of_their_fields_as_documented():
    steps = transitions(phase_end=True, scores_due=3)
    plain = b'Transitions\0' + text('sim') + b''.join(map(number, (0, 0, 0, 0, 5)))
    for array in (steps.observations, steps.actions):
        plain += b'\2' + struct.pack('<QQ', *array.shape)
        plain += b''.join(struct.pack('<f', x) for x in array.reshape(-1).tolist())
    plain += b'\0\0\1' + number(3)
    assert raw_digest(steps) == hashlib.sha256(plain).digest()


def test_the_digest_of_several_is_that_of_their_digests_in_order():
    first, second = score(), score(sequence=1)
    both = hashlib.sha256(raw_digest(first) + raw_digest(second)).hexdigest()
    assert digest_of_all([first, second]) == both != digest_of_all([second, first])
    assert digest_of_all([]) == hashlib.sha256(b'').hexdigest()


def other(value):
    """A value of the same type that differs as little as it can."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, (int, float)):
        return value + 1
    if isinstance(value, str):
        return value + ' '
    if isinstance(value, bytes):
        return value[:-1] + bytes([value[-1] ^ 1])
    if isinstance(value, tuple):
        return (*value, 'more')
    changed = value.copy()
    raw = changed.reshape(-1).view(np.uint8)
    raw[-1] ^= 1
    return changed


CASES = [
    pytest.param(kind, f.name, id=f'{kind.__name__}.{f.name}')
    for kind in RECORDS
    for f in fields(kind)
]


@pytest.mark.parametrize(('kind', 'name'), CASES)
def test_every_field_counts_but_those_that_every_receiver_checks(kind, name):
    record = RECORDS[kind]
    changed = replace(record, **{name: other(getattr(record, name))})
    unseen = {('StepRewards', 'commit')}  # the labels are the same, whatever they were made of
    unseen |= {(each.__name__, 'run_id') for each in RECORDS if each is not Commit}
    assert (digest(changed) == digest(record)) == ((kind.__name__, name) in unseen)


def test_neither_the_memory_nor_the_dtype_of_an_array_counts():
    steps = transitions()
    strided = np.asfortranarray(steps.observations)
    assert digest(replace(steps, observations=strided)) == digest(steps)
    wide = replace(policy(), steps=np.array([200], np.int64))
    assert digest(wide) == digest(policy())


def test_fields_that_change_places_are_another_record():
    assert digest(score(episode=1, first_step=2)) != digest(score(episode=2, first_step=1))
    names = {'role': 'a', 'node': 'b', 'phase': 0, 'step': 0, 'values': np.zeros(2)}
    ab_c, a_bc = (Metrics(run_id='r', names=n, **names) for n in (('ab', 'c'), ('a', 'bc')))
    assert digest(ab_c) != digest(a_bc)
