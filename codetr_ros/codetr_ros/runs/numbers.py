"""Numbers for people: few digits, and never an exponent."""

import math
from collections.abc import Sequence

import numpy as np

SMALLEST = 1e-4
"""Measured numbers nearer to 0 are shown as less than this."""


def number(value: float | None, digits: int = 4, scale: float = 1.0) -> str:
    """A measured number with so many significant digits; empty text for None.

    A number nearer to 0 than `SMALLEST` of its scale is shown as below it, so that what was
    rounding error does not look like a result.

    Args:
        value: the number.
        digits: its significant digits.
        scale: size of the numbers that it is to be compared with.
    """
    if value is None:
        return ''
    least = SMALLEST * 10.0 ** math.floor(math.log10(scale))
    if 0 < abs(value) < least:
        return f'< {exact(least, 1)}' if value > 0 else f'> -{exact(least, 1)}'
    return exact(value, digits)


def exact(value: float, digits: int = 6) -> str:
    """A number that somebody chose, such as a setting: with so many significant digits, however
    small it is. The whole part is never rounded to tens.
    """
    if not math.isfinite(value):
        return str(value)
    if abs(value) >= 10 ** (digits - 1):
        return f'{value:.0f}'
    return np.format_float_positional(
        value, precision=digits, unique=False, fractional=False, trim='-'
    )


def returns(*values: float | None) -> list[str]:
    """Returns of episodes, with a decimal; with three if all are below 10. None: empty text."""
    known = [abs(value) for value in values if value is not None]
    return column(values, most=1 if max(known, default=0.0) >= 10 else 3)


def column(values: Sequence[float | None], digits: int = 5, most: int = 3) -> list[str]:
    """The numbers of a column, all with as many decimals as give the largest `digits` digits.

    If the largest is tiny, it has three digits.

    Args:
        values: the numbers; None becomes empty text.
        digits: significant digits of the largest.
        most: the most decimals.
    """
    known = [abs(value) for value in values if value is not None and math.isfinite(value)]
    largest = max(known, default=0.0)
    whole = math.floor(math.log10(largest)) + 1 if largest >= 1 else 1
    decimals = min(most, max(0, digits - whole))
    if 0 < largest < 10.0**-most:
        decimals = 2 - math.floor(math.log10(largest))
    return ['' if value is None else f'{value:.{decimals}f}' for value in values]
