"""Texts from anywhere, made fit for a log: none is endless, none can forge a line or colours."""

LONGEST_SHOWN = 200
"""The most characters of one value in a log."""
LONGEST_LINE = 4000
"""The most characters of a whole line."""


def shown(text: str, longest: int = LONGEST_SHOWN) -> str:
    """A text without control characters, cut off where it is too long."""
    short = text[:longest]
    if not short.isprintable():
        short = ''.join(c if c.isprintable() else ascii(c)[1:-1] for c in short)
    return short if len(text) <= longest else f'{short}... ({len(text)} characters)'


def worth_a_line(number: int) -> bool:
    """Whether the log names a refusal: the first ten of a kind, then every thousandth."""
    return number <= 10 or number % 1000 == 0
