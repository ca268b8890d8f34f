"""Parts of the HTML pages that reports are: style, escaped text, tables."""

import html
from collections.abc import Mapping, Sequence
from typing import Any

STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem;
color: #222 } h1 { font-size: 1.4rem } h2 { font-size: 1.1rem; margin-top: 2rem } table { border-
collapse: collapse } td, th { padding: .15rem .8rem .15rem 0; text-align: right; border-bottom: 1px
solid #ddd } td:first-child, th:first-child { text-align: left } th { font-weight: 600 } img { max-
width: 100% } .bad { color: #b00020; font-weight: 600 } code { font-size: .9em; overflow-wrap:
anywhere }
"""


def text(value: Any) -> str:
    """A value for people, escaped."""
    if value is None:
        return ''
    if isinstance(value, float):
        return f'{value:.6g}'
    return html.escape(
        ', '.join(map(str, value)) if isinstance(value, (list, tuple)) else str(value)
    )


def table(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A table; without a header where all its names are empty."""
    head = ''.join(f'<th>{text(name)}</th>' for name in header)
    body = ''.join(
        '<tr>' + ''.join(f'<td>{text(cell)}</td>' for cell in row) + '</tr>\n' for row in rows
    )
    return f'<table>{f"<tr>{head}</tr>" if any(header) else ""}\n{body}</table>'


def records(rows: Sequence[Mapping[str, Any]]) -> str:
    """A table of rows with the same names."""
    if not rows:
        return '<p>none</p>'
    names = list(rows[0])
    return table(
        [n.replace('_', ' ') for n in names], [[row.get(n) for n in names] for row in rows]
    )


def flat(settings: Mapping[str, Any], prefix: str = '') -> list[list[Any]]:
    """Dotted names and values of nested settings."""
    found: list[list[Any]] = []
    for name, value in settings.items():
        if isinstance(value, Mapping):
            found += flat(value, f'{prefix}{name}.')
        else:
            found.append([prefix + name, value])
    return found
