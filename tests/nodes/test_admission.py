"""With a key, what is not signed, not of its role or not new is refused, whatever it contains."""

import pytest

from codetr_ros.bags.definitions import decode, decode_sent, encode
from codetr_ros.nodes.admission import Admission, Unknown
from codetr_ros.nodes.errors import NodeError
from codetr_ros.nodes.signing import VARIABLE, is_signed, key_of, new_key, signature, signed
from codetr_ros.nodes.traffic import Traffic
from codetr_ros.records import (
    TOPICS,
    Commit,
    Policy,
    Presence,
    RecordError,
    Transitions,
    metrics,
)
from helpers import builders
from helpers.builders import commit, policy, run, same, score, task_spec, tiny, transitions

KEY = bytes(range(32))
TOPIC = '/run/transitions'


def message(record, sender='a', stamp=1, key=KEY, topic=None):
    data = encode(record, stamp, sender=sender)
    return data if key is None else signed(key, topic or TOPICS[type(record)], data)


class Log:
    def error(self, text):
        self.said = text


def traffic():
    made = Traffic(Log(), lambda: 100.0, Admission(TOPICS.__getitem__, KEY, lambda: 60.0))
    made.admission.settings = tiny()
    return made


def presence(role, sender, **changes):
    return builders.presence(role, instance_id=sender, settings_hash='', **changes)


def test_a_signed_message_is_the_record_and_names_its_sender():
    data = message(transitions(), 'who')
    record, sender = decode_sent(Transitions, data)
    assert same(record, transitions()) and sender == 'who'
    assert same(decode(Transitions, message(transitions(), key=None)), transitions())


def test_a_signature_is_keyed_blake2b_of_the_topic_and_the_bytes_before_it():
    import hashlib

    data = message(transitions(), topic=TOPIC)
    digest = hashlib.blake2b(digest_size=32, key=KEY)
    digest.update(TOPIC.encode())
    digest.update(b'\0')
    digest.update(data[:-32])
    assert data[-32:] == digest.digest() == signature(KEY, TOPIC, data[:-32])
    for padded in range(4):  # the middleware may fill up to a multiple of four
        assert is_signed(KEY, TOPIC, data + bytes(padded))
    assert not is_signed(KEY, TOPIC, data + b'\1')
    assert not is_signed(KEY, '/other/transitions', data)
    assert not is_signed(bytes(32), TOPIC, data)
    for place in range(len(data)):
        assert not is_signed(
            KEY, TOPIC, data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :]
        )
    assert not any(is_signed(KEY, TOPIC, data[:length]) for length in range(40))


def test_a_key_is_64_digits_and_is_never_shown():
    assert key_of({}) is None
    assert key_of({VARIABLE: new_key()}) != key_of({VARIABLE: new_key()})
    for wrong in ('secret', 'ab' * 31, 'xy' * 32):
        with pytest.raises(NodeError) as refused:
            key_of({VARIABLE: wrong})
        assert wrong not in str(refused.value) and VARIABLE in str(refused.value)


@pytest.mark.parametrize(
    'record',
    [run(), task_spec(), transitions(), score(), commit(), policy(), presence('sim', 'liar')],
    ids=lambda record: type(record).__name__,
)
@pytest.mark.parametrize('key', [None, bytes(32)], ids=['not signed', 'another key'])
def test_a_stranger_is_refused_whatever_he_says(record, key):
    taken = traffic()
    assert taken.decode(type(record), message(record, 'liar', key=key)) is None
    assert taken.refused == {TOPICS[type(record)]: 1} and not taken.received
    assert 'is not signed with the key of this run' in taken._log.said


def test_a_second_process_of_a_role_is_refused_while_the_first_lives():
    taken = traffic()
    assert taken.decode(Policy, message(policy(), 'first'))
    assert taken.decode(Policy, message(policy(), 'second')) is None
    assert "is of a second learner, 'second', where 'first' has joined" in taken._log.said
    assert taken.decode(Presence, message(presence('learner', 'second'), 'second')) is None
    last = presence('learner', 'first', finished=True)
    assert taken.decode(Presence, message(last, 'first', 2))
    assert taken.decode(Presence, message(presence('learner', 'second'), 'second', 3))
    assert taken.decode(Policy, message(policy(phase=1), 'second', 4))
    assert taken.decode(Policy, message(policy(phase=2), 'first', 5)) is None


def test_a_new_start_of_a_node_takes_its_place_and_what_it_said_before_is_taken():
    admission = Admission(TOPICS.__getitem__, KEY, lambda: 60.0)
    again = []
    now = [0.0]
    taken = Traffic(Log(), lambda: now[0], admission)
    assert taken.decode(Commit, message(commit(), 'first'))
    assert (
        taken.decode(Commit, message(commit(phase=1), 'new', 2), lambda *m: again.append(m))
        is None
    )
    now[0] = 61.0  # silent for longer than the deadline
    assert taken.decode(Presence, message(presence('record', 'new'), 'new', 3))
    assert [kind for kind, _ in again] == [Commit]
    assert taken.decode(*again[0])
    assert not taken.refused


def test_what_waits_for_a_place_in_vain_is_refused_in_the_end():
    now = [0.0]
    taken = Traffic(Log(), lambda: now[0], Admission(TOPICS.__getitem__, KEY, lambda: 60.0))
    assert taken.decode(Commit, message(commit(), 'first'))
    assert taken.decode(Commit, message(commit(phase=1), 'new', 2), lambda *_: None) is None
    assert not taken.refused
    now[0] = 11.0
    taken.expire()
    assert taken.refused == {'commits': 1} and taken.received == {'commits': 1}


@pytest.mark.parametrize(
    ('record', 'why'),
    [
        (commit(), "was published by sim 'sim': no sim publishes on 'commits'"),
        (policy(), "no sim publishes on 'policy'"),
        (transitions(source='sim_2'), "is of sim 'sim_2', but was published by sim 'sim'"),
        (metrics('run', 'learner', 'learner', 0, 0, {}), 'is of learner, but was published'),
        (presence('learner', 'a'), 'is of learner, but was published by sim'),
        (presence('sim', 'other'), "has instance_id 'other' and sender 'a'"),
    ],
)  # fmt: skip
def test_no_node_publishes_for_another(record, why):
    taken = traffic()
    assert taken.decode(Transitions, message(transitions()))
    assert taken.decode(type(record), message(record, stamp=2)) is None
    assert why in taken._log.said


def test_a_repetition_of_an_old_message_is_refused():
    taken = traffic()
    old, new = message(presence('sim', 'a'), stamp=1), message(presence('sim', 'a'), stamp=2)
    assert taken.decode(Presence, old) and taken.decode(Presence, new)
    assert taken.decode(Presence, old) is None and taken.decode(Presence, new) is None
    assert 'it is a repetition of an old message' in taken._log.said


def test_a_simulator_too_many_is_refused():
    taken = traffic()
    assert taken.decode(Transitions, message(transitions(), 'a'))
    assert taken.decode(Transitions, message(transitions(source='sim_2'), 'b')) is None
    assert "one simulator too many, sim 'sim_2'" in taken._log.said


def test_a_scorer_that_is_no_node_is_the_first_of_its_name():
    taken = traffic()
    kind = type(score())
    assert taken.decode(kind, message(score(scorer='inspection'), 'one'))
    assert taken.decode(kind, message(score(scorer='inspection', sequence=1), 'two', 2)) is None
    assert "where 'one' is the scorer 'inspection'" in taken._log.said
    assert taken.decode(kind, message(score(scorer='inspection', sequence=1), 'one', 3))


def test_without_a_key_nobody_is_refused_for_who_he_is():
    admission = Admission(TOPICS.__getitem__, None, lambda: 60.0)
    admission.check_signature(Commit, b'')
    for sender in ('', 'first', 'second'):
        admission.admit(commit(), sender, message(commit(), sender, key=None), 0.0)


def test_what_is_fetched_again_must_be_signed_and_of_its_role():
    admission = Admission(TOPICS.__getitem__, KEY, lambda: 60.0)
    admission.check_again(commit(), 'of before this node was started')
    admission.admit(transitions(), 'a', message(transitions()), 0.0)
    with pytest.raises(RecordError, match="no sim publishes on 'commits'"):
        admission.check_again(commit(), 'a')
    assert issubclass(Unknown, RecordError)
