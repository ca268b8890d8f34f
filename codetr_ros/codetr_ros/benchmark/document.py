"""A document of headings, paragraphs, lists, tables and pictures, as Markdown and as HTML."""

import html
from collections.abc import Sequence
from dataclasses import dataclass

_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; max-width: 72rem; margin: 2rem auto;
  padding: 0 1rem; color: #222 }
h1 { font-size: 1.4rem } h2 { font-size: 1.15rem; margin-top: 2.2rem } h3 { font-size: 1rem }
table { border-collapse: collapse; display: block; overflow-x: auto }
td, th { padding: .2rem .8rem .2rem 0; text-align: right; border-bottom: 1px solid #ddd;
  white-space: nowrap }
td:first-child, th:first-child { text-align: left }
th { font-weight: 600 } img { max-width: 100% }
pre { background: #f5f5f5; padding: .6rem; overflow-x: auto; font-size: .85em }
"""


@dataclass(frozen=True)
class Heading:
    """A heading; the document's title has level 1."""

    text: str
    level: int = 2


@dataclass(frozen=True)
class Paragraph:
    """Running text."""

    text: str


@dataclass(frozen=True)
class Items:
    """A list."""

    texts: Sequence[str]


@dataclass(frozen=True)
class Bold:
    """A table's cell in boldface."""

    text: str


@dataclass(frozen=True)
class Table:
    """A table; the first column is text, the others are numbers."""

    head: Sequence[str]
    rows: Sequence[Sequence[str | Bold]]


@dataclass(frozen=True)
class Picture:
    """A PNG beside the document."""

    file: str
    alt: str


@dataclass(frozen=True)
class Verbatim:
    """What a program printed."""

    text: str


Block = Heading | Paragraph | Items | Table | Picture | Verbatim


def markdown(blocks: Sequence[Block]) -> str:
    """The document as Markdown."""
    return '\n\n'.join(_markdown(block) for block in blocks) + '\n'


def _markdown(block: Block) -> str:
    match block:
        case Heading(text, level):
            return f'{"#" * level} {text}'
        case Paragraph(text):
            return text
        case Items(texts):
            return '\n'.join(f'- {text}' for text in texts)
        case Picture(file, alt):
            return f'![{alt}]({file})'
        case Verbatim(text):
            return '\n'.join(f'    {line}' for line in text.splitlines())
        case Table(head, rows):
            lines = [head, ['---', *['---:'] * (len(head) - 1)]]
            lines += [[_cell(cell) for cell in row] for row in rows]
            return '\n'.join(f'| {" | ".join(line)} |' for line in lines)


def _cell(cell: str | Bold) -> str:
    if isinstance(cell, Bold):
        return f'**{_cell(cell.text)}**'
    return cell.replace('|', '\\|').replace('\n', ' ')


def page(blocks: Sequence[Block]) -> str:
    """The document as an HTML page."""
    title = next(block.text for block in blocks if isinstance(block, Heading))
    return '\n'.join(
        [
            '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">',
            f'<title>{html.escape(title)}</title><style>{_STYLE}</style></head><body>',
            *(_html(block) for block in blocks),
            '</body></html>\n',
        ]
    )


def _html(block: Block) -> str:
    match block:
        case Heading(text, level):
            return f'<h{level}>{html.escape(text)}</h{level}>'
        case Paragraph(text):
            return f'<p>{html.escape(text)}</p>'
        case Items(texts):
            return f'<ul>{"".join(f"<li>{html.escape(text)}</li>" for text in texts)}</ul>'
        case Picture(file, alt):
            return f'<img src="{html.escape(file)}" alt="{html.escape(alt)}">'
        case Verbatim(text):
            return f'<pre>{html.escape(text)}</pre>'
        case Table(head, rows):
            first = ''.join(f'<th>{html.escape(name)}</th>' for name in head)
            others = '\n'.join(
                f'<tr>{"".join(f"<td>{_html_cell(cell)}</td>" for cell in row)}</tr>'
                for row in rows
            )
            return f'<table><tr>{first}</tr>\n{others}</table>'


def _html_cell(cell: str | Bold) -> str:
    return f'<b>{html.escape(cell.text)}</b>' if isinstance(cell, Bold) else html.escape(cell)
