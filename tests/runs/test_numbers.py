"""Numbers for people."""

import re

import numpy as np
import pytest

from codetr_ros.runs.numbers import column, exact, number, returns


@pytest.mark.parametrize(
    ('value', 'shown'),
    [
        (0.0, '0'),
        (6.5e-06, '< 0.0001'),
        (-6.5e-06, '> -0.0001'),
        (0.00012345, '0.0001234'),
        (9358.684, '9359'),
        (52.89128, '52.89'),
        (1234567.8, '1234568'),
        (-1.5, '-1.5'),
        (None, ''),
        (float('nan'), 'nan'),
    ],
)
def test_a_measured_number_has_four_digits_and_what_is_next_to_nothing_is_shown_so(value, shown):
    assert number(value) == shown


@pytest.mark.parametrize(
    ('value', 'shown'),
    [
        (5e-05, '0.00005'),
        (1e-07, '0.0000001'),
        (0.1 + 0.2, '0.3'),
        (1e9, '1000000000'),
        (3.0, '3'),
    ],
)
def test_a_chosen_number_is_shown_however_small_it_is(value, shown):
    assert exact(value) == shown


def test_no_number_has_an_exponent_and_every_one_is_right_to_its_digits():
    rng = np.random.default_rng(0)
    for value in rng.normal(size=300) * 10.0 ** rng.integers(-12, 12, 300):
        for text, error in ((exact(value), 1e-5), (number(value), 1e-3)):
            assert re.fullmatch(r'(< |> )?-?\d+(\.\d+)?', text), (value, text)
            if text[0] not in '<>':
                assert float(text) == pytest.approx(value, rel=error)


def test_the_numbers_of_a_column_have_the_same_decimals():
    assert column([9358.684, 52.89128, None, 6.5e-06]) == ['9358.7', '52.9', '', '0.0']
    assert column([0.999859, 0.00565, 3.2e-05]) == ['1.000', '0.006', '0.000']
    assert column([123456.7, -3.0]) == ['123457', '-3']
    assert column([]) == []


def test_returns_have_a_decimal_and_small_ones_more():
    assert returns(9358.684, 0.3) == ['9358.7', '0.3']
    assert returns(-5.934, 1.2) == ['-5.934', '1.200']
    assert returns(6.512e-06, None) == ['0.00000651', '']


def test_numbers_of_a_tiny_scale_keep_their_digits():
    assert column([6.512e-06, -1.2e-07]) == ['0.00000651', '-0.00000012']
    assert number(6.512e-06, scale=1e-05) == '0.000006512'
    assert number(1e-12, scale=1e-05) == '< 0.000000001'
    assert number(0.5, scale=1e6) == '< 100'
