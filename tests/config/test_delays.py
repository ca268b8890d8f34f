"""The delay: what it may be, and where it cuts episodes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from codetr_ros import config
from codetr_ros.config import Lengths, Settings, SettingsError, delay_in_words
from codetr_ros.config.delays import LONGEST


def ends(delay: int | str, steps: int, seed=0, source='sim', episode=0) -> list[int]:
    return Lengths.of(delay).ends(seed, source, episode, steps).tolist()


@pytest.mark.parametrize(
    ('given', 'held'),
    [(25, 25), ('25', 25), ('10:50', '10:50'), ('010:50', '10:50'), ('episode', 'episode')],
)
def test_a_delay_is_a_number_two_of_them_or_an_episode(given, held):
    assert config.parse({'delay': given}, 'test').delay == held


@pytest.mark.parametrize(
    ('given', 'why'),
    [
        (0, 'a segment has 1 to 100000 steps'),
        (LONGEST + 1, 'a segment has 1 to 100000 steps'),
        ('0:5', 'a segment has 1 to 100000 steps'),
        ('5:5', 'the second number must be the larger one'),
        ('50:10', 'the second number must be the larger one'),
        ('10:', 'a delay is a number of steps'),
        ('10-50', 'a delay is a number of steps'),
        (2.5, 'a delay is a number of steps'),
        (True, 'a delay is a number of steps'),
        (None, 'a delay is a number of steps'),
        ('episodes', 'a delay is a number of steps .25., two of them'),
    ],
)
def test_anything_else_is_refused_with_what_is_allowed(given, why):
    with pytest.raises(SettingsError, match=rf'test: delay = {given!r}: .*{why}'):
        config.parse({'delay': given}, 'test')


def test_two_numbers_in_a_yaml_file_are_no_number_of_base_sixty(tmp_path):
    file = tmp_path / 'mine.yaml'
    file.write_text('delay: 10:50\nsteps: 1_000\n')
    settings = config.load(str(file))
    assert (settings.delay, settings.steps) == ('10:50', 1000)


def test_drawn_lengths_survive_the_json_of_a_run():
    settings = Settings(delay='10:50')  # type: ignore[call-arg]
    assert config.from_canonical(settings.canonical(), 'test') == settings


def test_a_number_cuts_at_its_multiples():
    assert ends(7, 20) == [7, 14]
    assert ends(7, 21) == [7, 14, 21]
    assert ends(7, 6) == []


def test_an_episode_is_cut_by_its_end_alone():
    assert ends('episode', 1000) == []


@given(least=st.integers(1, 30), more=st.integers(1, 40), steps=st.integers(0, 500))
def test_drawn_lengths_lie_between_the_two_numbers_and_do_not_depend_on_how_far_one_looks(
    least, more, steps
):
    delay = f'{least}:{least + more}'
    found = ends(delay, steps)
    lengths = np.diff([0, *found])
    assert ((lengths >= least) & (lengths <= least + more)).all()
    far = ends(delay, 2 * steps + 100)
    assert far[: len(found)] == found and far[len(found)] > steps


def test_all_lengths_are_drawn_about_equally_often():
    lengths = np.concatenate(
        [np.diff([0, *ends('3:7', 1000, episode=e)], prepend=0)[1:] for e in range(20)]
    )
    counts = np.bincount(lengths, minlength=8)[3:]
    assert len(lengths) > 3500 and counts.sum() == len(lengths)
    assert np.abs(counts / len(lengths) - 0.2).max() < 0.03


def test_each_seed_source_and_episode_has_cuts_of_its_own():
    others = [{}, {'seed': 1}, {'source': 'sim_2'}, {'episode': 1}]
    assert len({tuple(ends('3:30', 1000, **other)) for other in others}) == 4


def test_an_episode_has_as_many_steps_as_the_horizon_of_its_task():
    settings = Settings(delay='episode')  # type: ignore[call-arg]
    with pytest.raises(SettingsError, match='delay = episode: how long segments are depends on'):
        _ = settings.longest
    assert settings.within(50).longest == settings.within(50).delay == 50
    drawn = Settings(delay='10:50')  # type: ignore[call-arg]
    assert drawn.within(1000) is drawn and drawn.longest == 50


def test_titles_state_a_delay_in_words():
    assert [delay_in_words(d) for d in (25, '10:50', 'episode')] == [
        '25 steps', '10 to 50 steps', 'whole episodes',
    ]  # fmt: skip
