"""The document that every report is made of."""

import html.parser
import re

import pytest
import tinycss2

from codetr_ros.runs import document
from codetr_ros.runs.document import (
    Bold,
    Facts,
    Folded,
    Gallery,
    Heading,
    Items,
    Links,
    Paragraph,
    Picture,
    Table,
    Verbatim,
    facts,
    records,
)

HOSTILE = '<script>alert("&")</script>'
BLOCKS = [
    Heading(HOSTILE, 1),
    Paragraph(HOSTILE, bad=True),
    Items([HOSTILE]),
    Table(['name', HOSTILE], [[HOSTILE, Bold(HOSTILE)]]),
    Facts([(HOSTILE, HOSTILE)]),
    Picture('curve.png', HOSTILE),
    Verbatim(HOSTILE),
    Gallery([Picture(b'PNG', HOSTILE)]),
    Links([('bag/', HOSTILE)]),
    Folded(HOSTILE, [Paragraph(HOSTILE)]),
]


def declarations() -> list[tinycss2.ast.Declaration]:
    found = []
    for rule in tinycss2.parse_stylesheet(
        document.STYLE, skip_comments=True, skip_whitespace=True
    ):
        assert rule.type == 'qualified-rule', rule
        found += tinycss2.parse_declaration_list(
            rule.content, skip_comments=True, skip_whitespace=True
        )
    return found


def test_a_browser_drops_no_declaration_of_the_style_sheet():
    broken = [d for d in declarations() if d.type != 'declaration']
    assert not broken, [error.message for error in broken]
    values = {d.name: tinycss2.serialize(d.value).strip() for d in declarations()}
    assert values['border-collapse'] == 'collapse'
    assert values['max-width'] in ('72rem', '46rem', 'min(100%, 46rem)')


def test_the_style_sheet_has_a_rule_for_every_class_that_a_page_uses():
    page = document.page(BLOCKS)
    used = set(re.findall(r'class="?([a-z]+)"?', page))
    assert used == set(re.findall(r'^\.([a-z]+)', document.STYLE, re.M))


class Tags(html.parser.HTMLParser):
    """The tags of a page, and whether each is closed where it should be."""

    EMPTY = {'meta', 'img', 'br'}

    def __init__(self):
        super().__init__()
        self.open, self.seen = [], []

    def handle_starttag(self, tag, attrs):
        self.seen.append(tag)
        if tag not in self.EMPTY:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_what_a_run_names_is_escaped_and_every_tag_is_closed():
    tags = Tags()
    tags.feed(document.page(BLOCKS))
    assert not tags.open
    assert 'script' not in tags.seen
    assert {'h1', 'p', 'ul', 'table', 'img', 'pre', 'b', 'a', 'details', 'summary'} <= set(
        tags.seen
    )


def test_a_picture_given_as_bytes_lies_in_the_page_itself():
    page = document.page([Heading('t', 1), Picture(b'\x89PNG', 'curve')])
    assert '<img alt="curve" src="data:image/png;base64,iVBORw==">' in page


def test_markdown_holds_no_bytes_and_says_so():
    with pytest.raises(ValueError, match="picture 'curve': .* file name"):
        document.markdown([Picture(b'\x89PNG', 'curve')])


def test_what_is_folded_and_what_is_linked_is_in_markdown_too():
    text = document.markdown(
        [Folded('More', [Paragraph('inside')]), Links([('bag/', 'the recording')])]
    )
    assert text == '### More\n\ninside\n\n- [bag/](bag/): the recording\n'


def test_a_terminal_gets_aligned_tables_without_pictures():
    text = document.plain(
        [
            Heading('Scores'),
            Picture('curve.png', 'curve'),
            Table(['method', 'score'], [['none', '0.5'], ['codetr', Bold('12.25')]]),
            Facts([('a', '1'), ('long', '2')]),
        ]
    )
    assert text.splitlines() == [
        'Scores',
        '',
        'method   score',
        'none       0.5',
        'codetr  12.25*',
        '',
        'a     1',
        'long  2',
    ]


def test_markdown_keeps_a_table_whole_whatever_its_cells_hold():
    text = document.markdown([Table(['a', 'b'], [['1|2', Bold('3\n4')]])])
    assert text.splitlines() == ['| a | b |', '| --- | ---: |', '| 1\\|2 | **3 4** |']


def test_values_for_people_are_short_numbers_lists_with_commas_and_nothing_for_none():
    shown = facts(
        {'rate': 0.1 + 0.2, 'hidden': (256, 256), 'seed': 7, 'failure': None, 'tiny': 6.5e-06}
        | {'overlap': True}
    )
    assert list(shown.rows) == [
        ('rate', '0.3'),
        ('hidden', '256, 256'),
        ('seed', '7'),
        ('failure', ''),
        ('tiny', '0.0000065'),
        ('overlap', 'yes'),
    ]


def test_rows_of_the_same_names_are_a_table_and_no_rows_are_a_word():
    assert records([{'step_s': 1, 'of': 2.5}]) == Table(['step s', 'of'], [['1', '2.5']])
    assert records([]) == Paragraph('none')
