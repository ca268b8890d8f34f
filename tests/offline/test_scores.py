"""A score is of the steps that the mapping defines, or it is dropped and counted.

Attempts have four steps of 0.1 s, and the first begins at 1 s, 11 s, 21 s and so on. So a test can
work out by hand which steps a score is of.
"""

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from codetr_ros.bags.errors import Place
from codetr_ros.bags.reader import Message
from codetr_ros.config import SettingsError, validate
from codetr_ros.offline.converting import Converter
from codetr_ros.records import CompositeReward
from codetr_ros.robots import conversion
from codetr_ros.robots.errors import MessageError
from codetr_ros.robots.mapping import Mapping
from codetr_ros.robots.message_fields import NS

STEPS = 4
EVERY = 10.0  # [s] between the begins of two attempts


def received(at: float, topic: str, **fields: Any) -> Message:
    """A message received at a time [s]."""
    time = round(at * NS)
    place = Place(Path('bag'), 0)
    return Message('x/msg/X', SimpleNamespace(**fields), topic, time, time, place)


def stamp(at: float) -> SimpleNamespace:
    sec, nanosec = divmod(round(at * NS), NS)
    return SimpleNamespace(sec=sec, nanosec=nanosec)


def verdict(at: float, value: float, **fields: Any) -> Message:
    return received(at, '/score', data=value, **fields)


def attempts(number: int, ended: bool = True, lost: tuple[int, ...] = ()) -> Iterator[Message]:
    """Attempts 0, 1, ...: commands at 1.0, 1.1, ... s, and a message 0.1 s after the last.

    Args:
        number: of attempts.
        ended: whether the messages at their ends are there.
        lost: steps of each attempt whose observations are not finite.
    """
    for attempt in range(number):
        begin = 1.0 + EVERY * attempt
        for step in range(STEPS):
            value = np.nan if step in lost else float(step)
            yield received(begin + 0.1 * step - 0.01, '/state', data=[value])
            yield received(begin + 0.1 * step, '/command', data=[0.0])
        yield received(begin + 0.1 * STEPS - 0.01, '/state', data=[9.0])
        if ended:
            yield received(begin + 0.1 * STEPS, '/end', data=f'attempt {attempt}')


def book(
    score: dict[str, Any], *messages: Message, episode: dict[str, Any] | None = None
) -> tuple[list[tuple[int, int, int, float]], dict[str, int]]:
    """Scores (episode, first step, length, value) of messages, and what was dropped."""
    ordered = sorted(messages, key=lambda message: message.log_time)
    return book_in_order(score, *ordered, episode=episode)


def book_in_order(
    score: dict[str, Any], *messages: Message, episode: dict[str, Any] | None = None
) -> tuple[list[tuple[int, int, int, float]], dict[str, int]]:
    """The same, of messages in the order of a bag."""
    plain = {
        'observation': [{'topic': '/state', 'fields': ['data']}],
        'action': {'topic': '/command', 'fields': ['data']},
        'score': {'topic': '/score', **score},
        'episode': {'topic': '/end'} if episode is None else episode,
    }
    converter = Converter(validate(Mapping, plain, 'test'), 'run')
    records = [r for message in messages for r, _ in converter.feed(message)]
    records += [r for r, _ in converter.finish()]
    scores = [
        (r.episode, r.first_step, r.length, r.value)
        for r in records
        if isinstance(r, CompositeReward)
    ]
    return scores, dict(converter.conversion.dropped)


LATE = [verdict(11.25 + EVERY * k, 100.0 * k) for k in range(3)]
"""The verdicts of three attempts, each received in the middle of the next one."""


# ------------------------------------------------------------------------------------------
# by reception


def test_a_verdict_that_may_be_of_the_attempt_before_is_dropped_and_counted():
    scores, dropped = book({}, *attempts(4), *LATE)
    assert scores == []
    assert dropped == {conversion.SCORE_OF_EITHER: 3}


def test_so_is_one_that_comes_when_the_next_attempt_has_ended_too():
    scores, dropped = book({}, *attempts(3), verdict(15.0, 0.0), verdict(25.0, 1.0))
    assert scores == []
    assert dropped == {conversion.SCORE_OF_EITHER: 2}


def test_two_late_verdicts_of_each_attempt_are_not_booked_either():
    late = [verdict(11.0 + EVERY * k + d, 0.0) for k in range(2) for d in (0.05, 0.25)]
    scores, dropped = book({}, *attempts(3), *late)
    assert scores == []
    assert dropped == {conversion.SCORE_OF_EITHER: 4}


def test_with_its_lateness_it_is_of_the_end_of_the_attempt_before():
    scores, dropped = book({'late': 12.0}, *attempts(4), *LATE)
    assert scores == [(0, 0, 4, 0.0), (1, 0, 4, 100.0), (2, 0, 4, 200.0)]
    assert dropped == {}


def test_no_lateness_has_scores_follow_the_running_attempt():
    scores, dropped = book({'late': 0.0}, *attempts(4), *LATE)
    assert scores == [(1, 0, 3, 0.0), (2, 0, 3, 100.0), (3, 0, 3, 200.0)]
    assert dropped == {}


def test_a_lateness_that_two_attempts_without_a_score_share_does_not_decide_between_them():
    scores, dropped = book({'late': 30.0}, *attempts(3), verdict(21.25, 1.0))
    assert scores == []
    assert dropped == {conversion.SCORE_OF_EITHER: 1}


def test_a_score_later_than_allowed_is_dropped():
    scores, dropped = book({'late': 2.0}, *attempts(1), verdict(3.5, 1.0))
    assert scores == []
    assert dropped == {conversion.SCORE_LATE: 1}


def test_a_score_of_the_last_steps_may_be_of_the_attempt_before_too():
    scores, dropped = book({'of': 'last_steps', 'steps': 2}, *attempts(4), *LATE)
    assert scores == []
    assert dropped == {conversion.SCORE_OF_EITHER: 3}


@pytest.mark.parametrize('lost', [1, 2])
def test_the_first_score_after_lost_steps_is_of_these_too(lost):
    verdicts = [verdict(1.35, 1.0), verdict(11.35, 2.0)]
    scores, dropped = book({}, *attempts(2, lost=(lost,)), *verdicts)
    assert scores == []
    assert dropped[conversion.SCORE_OF_PART] == 2


# ------------------------------------------------------------------------------------------
# second scores


@pytest.mark.parametrize(
    ('again', 'value', 'counted'),
    [('first', 1.0, conversion.SCORE_SECOND), ('replace', 2.0, conversion.SCORE_REPLACED)],
)
@pytest.mark.parametrize(
    ('score', 'first', 'correction'),
    [
        ({}, verdict(1.5, 1.0), verdict(2.0, 2.0)),
        ({'of': 'last_steps', 'steps': 4}, verdict(1.5, 1.0), verdict(2.0, 2.0)),
        ({'of': 'last_episode'}, verdict(1.5, 1.0), verdict(11.2, 2.0)),
        (
            {'of': 'window', 'seconds': 1.0, 'stamp': 'stamp'},
            verdict(1.5, 1.0, stamp=stamp(1.5)),
            verdict(2.0, 2.0, stamp=stamp(1.5)),
        ),
        (
            {'of': 'episode', 'stamp': 'stamp'},
            verdict(1.5, 1.0, stamp=stamp(1.2)),
            verdict(25.0, 2.0, stamp=stamp(1.3)),
        ),
    ],
)
def test_a_second_score_of_the_same_steps(score, first, correction, again, value, counted):
    scores, dropped = book({**score, 'again': again}, *attempts(3), first, correction)
    assert scores == [(0, 0, 4, value)]
    assert dropped == {counted: 1}


def test_a_correction_is_no_segment_of_one_step():
    """It comes 0.1 s after the score, when one more step has begun."""
    messages = [*attempts(1), verdict(1.15, 1.0), verdict(1.25, 2.0), verdict(1.41, 3.0)]
    scores, dropped = book({'again': 'replace', 'again_within': 0.12}, *messages)
    assert scores == [(0, 0, 2, 2.0), (0, 2, 2, 3.0)]
    assert dropped == {conversion.SCORE_REPLACED: 1}
    assert book({}, *messages)[0] == [(0, 0, 2, 1.0), (0, 2, 1, 2.0), (0, 3, 1, 3.0)]


def test_a_correction_may_come_when_the_next_attempt_has_begun():
    scores, dropped = book(
        {'again': 'replace', 'again_within': 10.0},
        *attempts(2),
        verdict(1.45, 1.0),
        verdict(11.05, 2.0),
    )
    assert scores == [(0, 0, 4, 2.0)]
    assert dropped == {conversion.SCORE_REPLACED: 1}


@pytest.mark.parametrize('value', [np.nan, np.inf, -1e300])
def test_a_score_that_cannot_be_used_is_dropped_and_leaves_its_steps_to_no_other(value):
    verdicts = [verdict(1.15, value), verdict(1.35, 2.0), verdict(11.35, 3.0)]
    scores, dropped = book({}, *attempts(2), *verdicts)
    assert scores == [(0, 2, 2, 2.0), (1, 0, 4, 3.0)]
    finite = np.isfinite(value)
    assert dropped == {conversion.SCORE_TOO_LARGE if finite else conversion.SCORE_NOT_FINITE: 1}


@pytest.mark.parametrize('again', ['first', 'replace'])
@pytest.mark.parametrize('values', [(np.nan, 2.0), (2.0, np.nan)])
def test_a_score_that_cannot_be_used_never_counts_as_the_first_or_the_second(again, values):
    verdicts = [verdict(2.0 + i, value) for i, value in enumerate(values)]
    scores, dropped = book({'again': again}, *attempts(1), *verdicts)
    assert scores == [(0, 0, 4, 2.0)]
    assert dropped == {conversion.SCORE_NOT_FINITE: 1}


# ------------------------------------------------------------------------------------------
# whole episodes


@pytest.mark.parametrize('ended', [True, False])
def test_a_verdict_of_the_last_episode_may_come_when_the_next_one_runs(ended):
    scores, dropped = book({'of': 'last_episode'}, *attempts(4, ended), *LATE)
    assert scores == [(0, 0, 4, 0.0), (1, 0, 4, 100.0), (2, 0, 4, 200.0)]
    assert dropped == {}


def test_without_a_message_at_its_end_an_episode_has_ended_with_its_last_step():
    """The pause is not over when the verdict comes."""
    scores, _ = book({'of': 'last_episode'}, *attempts(2, False), verdict(1.6, 1.0))
    assert scores == [(0, 0, 4, 1.0)]
    scores, _ = book({'of': 'last_episode'}, *attempts(2, False), verdict(11.6, 1.0))
    assert scores == [(1, 0, 4, 1.0)]


def test_a_verdict_right_before_the_message_that_ends_an_episode_is_of_that_one():
    verdicts = [verdict(1.399, 0.0), verdict(11.399, 1.0)]
    scores, dropped = book({'of': 'last_episode'}, *attempts(2), *verdicts)
    assert scores == [(0, 0, 4, 0.0), (1, 0, 4, 1.0)]
    assert dropped == {}


def test_unless_the_episode_before_has_no_score_yet():
    scores, dropped = book({'of': 'last_episode'}, *attempts(2), verdict(11.399, 1.0))
    assert scores == []
    assert dropped == {conversion.SCORE_OF_EITHER: 1}


def test_a_verdict_before_any_episode_has_ended_is_of_none():
    scores, dropped = book({'of': 'last_episode'}, *attempts(1), verdict(1.15, 1.0))
    assert scores == []
    assert dropped == {conversion.SCORE_WITHOUT_EPISODE: 1}


def test_a_verdict_later_than_allowed_is_dropped():
    verdicts = [verdict(1.4 + 9.5, 0.0), verdict(11.4 + 9.7, 1.0)]
    scores, dropped = book({'of': 'last_episode', 'late': 9.6}, *attempts(3), *verdicts)
    assert scores == [(0, 0, 4, 0.0)]
    assert dropped == {conversion.SCORE_LATE: 1}


def test_a_verdict_of_an_attempt_in_which_steps_are_lost_is_dropped():
    scores, dropped = book({'of': 'last_episode'}, *attempts(1, lost=(1,)), verdict(1.5, 1.0))
    assert scores == []
    assert dropped[conversion.SCORE_OF_PART] == 1


def test_a_verdict_may_name_its_episode():
    """The verdicts come in another order, one of them while its attempt still runs."""
    score = {'of': 'episode', 'id': 'attempt'}
    verdicts = [
        verdict(21.15, 2.0, attempt='attempt 2'),
        verdict(21.2, 0.0, attempt='attempt 0'),
        verdict(25.0, 1.0, attempt='attempt 1'),
        verdict(26.0, 7.0, attempt='attempt 7'),
    ]
    episode = {'topic': '/end', 'id': 'data'}
    scores, dropped = book(score, *attempts(3), *verdicts, episode=episode)
    assert scores == [(0, 0, 4, 0.0), (1, 0, 4, 1.0), (2, 0, 4, 2.0)]
    assert dropped == {conversion.SCORE_WITHOUT_EPISODE: 1}


def test_the_message_between_two_episodes_may_name_the_next_one():
    score = {'of': 'episode', 'id': 'attempt'}
    verdicts = [verdict(25.0, k, attempt=f'attempt {k}') for k in range(3)]
    episode = {'topic': '/end', 'id': 'data', 'id_is_of': 'next'}
    scores, dropped = book(score, *attempts(3), *verdicts, episode=episode)
    assert scores == [(1, 0, 4, 0.0), (2, 0, 4, 1.0)]
    assert dropped == {conversion.SCORE_WITHOUT_EPISODE: 1}


def test_numbers_name_an_episode_as_well_as_texts():
    ends = [received(1.5, '/end', data=np.uint32(7))]
    verdicts = [verdict(2.0, 1.0, attempt='7')]
    scores, _ = book(
        {'of': 'episode', 'id': 'attempt'},
        *attempts(1, False),
        *ends,
        *verdicts,
        episode={'topic': '/end', 'id': 'data'},
    )
    assert scores == [(0, 0, 4, 1.0)]


def test_a_name_of_two_episodes_names_neither():
    ends = [received(1.4 + EVERY * k, '/end', data='again') for k in range(2)]
    messages = [*attempts(2, False), *ends, verdict(12.0, 1.0, attempt='again')]
    episode = {'topic': '/end', 'id': 'data'}
    score = {'of': 'episode', 'id': 'attempt'}
    scores, dropped = book(score, *messages, episode=episode)
    assert scores == []
    assert dropped == {conversion.SCORE_OF_NAMESAKES: 1}
    scores, dropped = book({**score, 'late': 5.0}, *messages, episode=episode)
    assert scores == [(1, 0, 4, 1.0)]
    assert dropped == {}


@pytest.mark.parametrize('at', [11.0, 11.25, 11.4, 15.0])
def test_a_verdict_may_carry_a_time_of_its_episode(at):
    score = {'of': 'episode', 'stamp': 'header.stamp'}
    header = SimpleNamespace(stamp=stamp(at))
    scores, dropped = book(score, *attempts(3), verdict(40.0, 1.0, header=header))
    assert scores == [(1, 0, 4, 1.0)]
    assert dropped == {}


# ------------------------------------------------------------------------------------------
# times


def test_a_window_before_the_reception_of_a_score():
    """[1.2 s, 1.4 s) and [11.05 s, 11.25 s)."""
    scores, dropped = book(
        {'of': 'window', 'seconds': 0.2}, *attempts(2), verdict(1.4, 1.0), verdict(11.25, 2.0)
    )
    assert scores == [(0, 2, 2, 1.0), (1, 1, 2, 2.0)]
    assert dropped == {}


def test_a_window_before_the_stamp_of_a_score():
    score = {'of': 'window', 'seconds': 0.2, 'stamp': 'header.stamp'}
    header = SimpleNamespace(stamp=stamp(1.25))
    scores, dropped = book(score, *attempts(3), verdict(21.15, 1.0, header=header))
    assert scores == [(0, 1, 2, 1.0)]
    assert dropped == {}
    scores, dropped = book({**score, 'late': 9.0}, *attempts(3), verdict(21.1, 1.0, header=header))
    assert scores == []
    assert dropped == {conversion.SCORE_LATE: 1}


def test_a_window_may_have_a_begin_of_its_own():
    score = {'of': 'window', 'begin': 'begin', 'stamp': 'end'}
    windows = [(1.0, 1.2), (1.2, 1.4), (11.1, 11.2), (5.0, 6.0), (1.3, 11.05)]
    verdicts = [
        verdict(20.0, i, begin=stamp(begin), end=stamp(end))
        for i, (begin, end) in enumerate(windows)
    ]
    scores, dropped = book(score, *attempts(2), *verdicts)
    assert scores == [(0, 0, 2, 0.0), (0, 2, 2, 1.0), (1, 1, 1, 2.0)]
    assert dropped == {conversion.SCORE_OF_NOTHING: 1, conversion.SCORE_ACROSS: 1}


def test_windows_that_share_steps_are_dropped_but_for_the_first():
    score = {'of': 'window', 'seconds': 0.2}
    scores, dropped = book(score, *attempts(1), verdict(1.2, 1.0), verdict(1.3, 2.0))
    assert scores == [(0, 0, 2, 1.0)]
    assert dropped == {conversion.SCORE_AGAIN: 1}


def test_the_steps_since_the_last_score_end_with_the_stamp():
    """Received much later, and in the middle of the next attempt."""
    verdicts = [verdict(11.15 + at, at, stamp=stamp(at)) for at in (1.15, 1.35, 11.15)]
    scores, dropped = book({'stamp': 'stamp'}, *attempts(3), *verdicts)
    assert scores == [(0, 0, 2, 1.15), (0, 2, 2, 1.35), (1, 0, 2, 11.15)]
    assert dropped == {}


def test_stamps_that_go_back_are_of_steps_that_were_scored():
    verdicts = [verdict(2.0 + i, i, stamp=stamp(at)) for i, at in enumerate((1.35, 1.15))]
    scores, dropped = book({'stamp': 'stamp'}, *attempts(2), *verdicts)
    assert scores == [(0, 0, 4, 0.0)]
    assert dropped == {conversion.SCORE_AGAIN: 1}


def test_a_stamp_ahead_of_the_reception_waits_for_its_steps():
    """As where the clock of the judge is 0.2 s ahead."""
    verdicts = [verdict(1.15, 1.0, stamp=stamp(1.35)), verdict(1.2, 2.0, stamp=stamp(99.0))]
    scores, dropped = book({'stamp': 'stamp'}, *attempts(1), *verdicts)
    assert scores == [(0, 0, 4, 1.0)]
    assert dropped == {conversion.SCORE_AHEAD: 1}


def test_a_stamp_of_a_clock_that_went_back_is_not_taken_for_one_of_the_new_clock():
    """Each attempt begins at 1 s of its clock; the verdict on the first comes in the second."""
    again = [*attempts(1), verdict(1.05, 1.0, stamp=stamp(1.4))]
    messages = [*attempts(1), *sorted(again, key=lambda m: m.log_time)]
    scores, dropped = book_in_order({'of': 'episode', 'stamp': 'stamp'}, *messages)
    assert scores == []
    assert dropped[conversion.SCORE_OF_EITHER] == 1


@pytest.mark.parametrize('value', [1_350_000_000, np.int64(1_350_000_000), 1.35, stamp(1.35)])
def test_a_time_may_be_a_message_nanoseconds_or_seconds(value):
    scores, _ = book({'stamp': 'stamp'}, *attempts(1), verdict(5.0, 1.0, stamp=value))
    assert scores == [(0, 0, 4, 1.0)]


def test_a_field_that_holds_no_time_is_named():
    with pytest.raises(
        MessageError, match=r"/score: field 'stamp' = 'now' holds no time: name a "
    ):
        book({'stamp': 'stamp'}, *attempts(1), verdict(5.0, 1.0, stamp='now'))


# ------------------------------------------------------------------------------------------
# the mapping


@pytest.mark.parametrize(
    ('score', 'episode', 'expected'),
    [
        ({'of': 'window'}, {}, 'score: seconds or begin must be given if `of` is window'),
        ({'seconds': 1.0}, {}, 'seconds means nothing if `of` is since_last: only for window'),
        ({'of': 'episode'}, {}, 'id or stamp must be given if `of` is episode, and not both'),
        (
            {'of': 'episode', 'id': 'x'},
            {},
            'test: score.id names an episode, but episodes have no',
        ),
        ({'of': 'window', 'seconds': 1.0, 'again_within': 1.0}, {}, 'again_within means nothing'),
        ({'late': -1.0}, {}, 'score.late = -1.0: Input should be greater than or equal to 0'),
        ({}, {'id': 'x'}, 'id without a topic'),
    ],
)
def test_a_score_that_is_not_defined_is_refused_by_name(score, episode, expected):
    with pytest.raises(SettingsError, match=expected):
        book(score, episode=episode)


def test_whole_episodes_at_a_fixed_rate_need_a_message_at_their_end():
    plain = {
        'observation': [{'topic': '/state', 'fields': ['data']}],
        'action': {'topic': '/command', 'fields': ['data']},
        'score': {'topic': '/score', 'of': 'last_episode'},
        'sampling': {'by': 'rate', 'rate': 10.0},
    }
    with pytest.raises(SettingsError, match='sampling.by is rate: .* Give episode.topic'):
        validate(Mapping, plain, 'test')
