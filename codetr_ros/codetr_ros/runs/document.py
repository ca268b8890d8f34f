"""A document of headings, paragraphs, lists, tables and pictures, as Markdown and as HTML.

The reports of a run, a fit and a benchmark are all made of these blocks. An HTML page needs no
network and, if its pictures are given as bytes, no other file.
"""

import base64
import html
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from codetr_ros.runs.numbers import exact

STYLE = """
:root { color-scheme: light dark }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 72rem; margin: 2rem auto;
  padding: 0 1rem }
h1 { font-size: 1.4rem; line-height: 1.3; overflow-wrap: anywhere }
h2 { font-size: 1.15rem; margin-top: 2.2rem }
h3 { font-size: 1rem }
p, li { max-width: 46rem }
img, video { max-width: min(100%, 46rem); height: auto; background: #fff }
pre { background: #8882; padding: .6rem; overflow-x: auto; font-size: .85em }
.wide { overflow-x: auto }
table { border-collapse: collapse }
th, td { padding: .2rem 0 .2rem 1.2rem; border-bottom: 1px solid #8885; text-align: right;
  white-space: nowrap; font-variant-numeric: tabular-nums }
th { font-weight: 600 }
th:first-child, td:first-child { padding-left: 0; text-align: left }
.facts th, .facts td { text-align: left; white-space: normal; overflow-wrap: anywhere;
  vertical-align: top }
.facts td:first-child { min-width: 9rem }
.bad { color: #d22d3a; font-weight: 600 }
.gallery { display: grid; gap: .8rem;
  grid-template-columns: repeat(auto-fill, minmax(min(22rem, 100%), 1fr)) }
.gallery img { width: 100% }
details { margin-top: 1.2rem }
summary { cursor: pointer; font-weight: 600 }
"""


@dataclass(frozen=True)
class Heading:
    """A heading; the document's title has level 1."""

    text: str
    level: int = 2


@dataclass(frozen=True)
class Paragraph:
    """Running text; `bad` marks a failure."""

    text: str
    bad: bool = False


@dataclass(frozen=True)
class Items:
    """A list."""

    texts: Sequence[str]


@dataclass(frozen=True)
class Bold:
    """A table's cell in boldface."""

    text: str


Cell = str | Bold


@dataclass(frozen=True)
class Table:
    """A table of numbers whose first column is text."""

    head: Sequence[str]
    rows: Sequence[Sequence[Cell]]


@dataclass(frozen=True)
class Facts:
    """Names with their values, a line for each; values may be long."""

    rows: Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Picture:
    """A PNG: the name of a file beside the document, or bytes that the HTML page holds itself."""

    source: str | bytes
    alt: str


@dataclass(frozen=True)
class Video:
    """An MP4 that the HTML page holds itself."""

    source: bytes
    alt: str


@dataclass(frozen=True)
class Gallery:
    """Small pictures, beside each other where there is room."""

    pictures: Sequence[Picture]


@dataclass(frozen=True)
class Links:
    """Files beside the document, each with what it is."""

    rows: Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Verbatim:
    """The output of a program."""

    text: str


@dataclass(frozen=True)
class Folded:
    """Blocks that a page shows on request only."""

    title: str
    blocks: 'Sequence[Block]'


Shown = Picture | Video | Gallery
Block = Heading | Paragraph | Items | Table | Facts | Shown | Links | Verbatim | Folded


def cell(value: Any) -> str:
    """A value for people: numbers with six digits and no exponent, sequences with commas, truth as
    `yes` and `no`, None as empty text.
    """
    if value is None:
        return ''
    if isinstance(value, bool):
        return 'yes' if value else 'no'
    if isinstance(value, float):
        return exact(value)
    if isinstance(value, (list, tuple)):
        return ', '.join(map(str, value))
    return str(value)


def facts(rows: Sequence[Sequence[Any]] | Mapping[str, Any]) -> Facts:
    """Names and values of any kind."""
    pairs = rows.items() if isinstance(rows, Mapping) else rows
    return Facts([(str(name), cell(value)) for name, value in pairs])


def records(rows: Sequence[Mapping[str, Any]]) -> Block:
    """A table of rows that have the same names; the word `none` if there is no row."""
    if not rows:
        return Paragraph('none')
    names = list(rows[0])
    lines = [[cell(row.get(name)) for name in names] for row in rows]
    return Table([name.replace('_', ' ') for name in names], lines)


def markdown(blocks: Sequence[Block]) -> str:
    """The document as Markdown."""
    return '\n\n'.join(_markdown(block) for block in blocks) + '\n'


def _markdown(block: Block) -> str:
    match block:
        case Heading(text, level):
            return f'{"#" * level} {text}'
        case Paragraph(text, bad):
            return f'**{text}**' if bad else text
        case Items(texts):
            return '\n'.join(f'- {text}' for text in texts)
        case Picture(source, alt):
            if isinstance(source, bytes):
                raise ValueError(f'picture {alt!r}: Markdown holds no bytes; give it a file name')
            return f'![{alt}]({source})'
        case Video(_, alt):
            raise ValueError(f'video {alt!r}: Markdown holds no bytes')
        case Gallery(pictures):
            return '\n'.join(_markdown(picture) for picture in pictures)
        case Links(rows):
            return '\n'.join(f'- [{target}]({target}): {text}' for target, text in rows)
        case Folded(title, blocks):
            return '\n\n'.join([f'### {title}', *(_markdown(each) for each in blocks)])
        case Verbatim(text):
            return '\n'.join(f'    {line}' for line in text.splitlines())
        case Table(head, rows):
            return '\n'.join(_lines([head, ['---', *['---:'] * (len(head) - 1)], *rows]))
        case Facts(pairs):
            return '\n'.join(_lines([['', ''], ['---', '---'], *pairs]))


def _lines(rows: Sequence[Sequence[Cell]]) -> Iterator[str]:
    for row in rows:
        yield f'| {" | ".join(_markdown_cell(each) for each in row)} |'


def _markdown_cell(each: Cell) -> str:
    if isinstance(each, Bold):
        return f'**{_markdown_cell(each.text)}**'
    return each.replace('|', '\\|').replace('\n', ' ')


def plain(blocks: Sequence[Block]) -> str:
    """The document for a terminal: tables aligned, bold cells with an asterisk, no pictures.

    Lines are as long as they are: a terminal wraps them, a file keeps them.
    """
    texts = (_plain(block) for block in blocks)
    return '\n\n'.join(text for text in texts if text) + '\n'


def _plain(block: Block) -> str:
    match block:
        case Heading(text, _) | Paragraph(text, _) | Verbatim(text):
            return text
        case Items(texts):
            return '\n'.join(f'- {text}' for text in texts)
        case Links(rows):
            return '\n'.join(f'- {target}: {text}' for target, text in rows)
        case Table(head, rows):
            return _aligned([head, *rows])
        case Facts(pairs):
            return _aligned(pairs, left=True)
        case Folded(title, blocks):
            return '\n\n'.join([title, *filter(None, map(_plain, blocks))])
        case Picture() | Video() | Gallery():
            return ''


def _aligned(rows: Sequence[Sequence[Cell]], left: bool = False) -> str:
    """Columns two spaces apart; all but the first are numbers, unless all are `left`."""
    cells = [[f'{c.text}*' if isinstance(c, Bold) else c for c in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = []
    for row in cells:
        shown = [
            cell.ljust(width) if left or not i else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append('  '.join(shown).rstrip())
    return '\n'.join(lines)


def page(blocks: Sequence[Block]) -> str:
    """The document as an HTML page. Its title is its first heading."""
    title = next(block.text for block in blocks if isinstance(block, Heading))
    return '\n'.join(
        [
            '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f'<title>{html.escape(title)}</title><style>{STYLE}</style></head><body>',
            *(_html(block) for block in blocks),
            '</body></html>\n',
        ]
    )


def _html(block: Block) -> str:
    match block:
        case Heading(text, level):
            return f'<h{level}>{html.escape(text)}</h{level}>'
        case Paragraph(text, bad):
            return f'<p{" class=bad" if bad else ""}>{html.escape(text)}</p>'
        case Items(texts):
            return f'<ul>{"".join(f"<li>{html.escape(text)}</li>" for text in texts)}</ul>'
        case Picture(source, alt):
            if isinstance(source, bytes):
                source = f'data:image/png;base64,{base64.b64encode(source).decode()}'
            return f'<img alt="{html.escape(alt)}" src="{html.escape(source)}">'
        case Video(data, alt):
            coded = base64.b64encode(data).decode()
            return (
                f'<video aria-label="{html.escape(alt)}" controls loop muted playsinline '
                f'src="data:video/mp4;base64,{coded}"></video>'
            )
        case Gallery(pictures):
            return f'<div class="gallery">{"".join(_html(each) for each in pictures)}</div>'
        case Links(rows):
            lines = ''.join(
                f'<li><a href="{html.escape(target)}">{html.escape(target)}</a>: '
                f'{html.escape(text)}</li>'
                for target, text in rows
            )
            return f'<ul>{lines}</ul>'
        case Folded(title, blocks):
            inner = '\n'.join(_html(each) for each in blocks)
            return f'<details><summary>{html.escape(title)}</summary>\n{inner}</details>'
        case Verbatim(text):
            return f'<pre>{html.escape(text)}</pre>'
        case Table(head, rows):
            top = ''.join(f'<th>{html.escape(name)}</th>' for name in head)
            return f'<div class="wide"><table><tr>{top}</tr>\n{_rows(rows)}</table></div>'
        case Facts(pairs):
            return f'<table class="facts">{_rows(pairs)}</table>'


def _rows(rows: Sequence[Sequence[Cell]]) -> str:
    return '\n'.join(
        f'<tr>{"".join(f"<td>{_html_cell(each)}</td>" for each in row)}</tr>' for row in rows
    )


def _html_cell(each: Cell) -> str:
    return f'<b>{html.escape(each.text)}</b>' if isinstance(each, Bold) else html.escape(each)
