"""Tables of the pages hold the numbers of the committed results."""

from pathlib import Path

import pytest
import tables


@pytest.mark.parametrize('page', sorted(tables.PAGES.glob('*.md')), ids=lambda page: page.stem)
def test_marked_tables_are_those_of_the_results(page: Path) -> None:
    text = page.read_text()
    assert tables.filled(text) == text, 'run benchmarks/tables.py pages'


def test_a_table_is_filled_in_between_its_marks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tables, 'RESULTS', tmp_path)
    (tmp_path / 'some').mkdir()
    head = 'task,composite,delay,method,seeds,planned,return_iqm,return_low,return_high,share,'
    head += 'within,cpu_s,reached,cpu_s_to,true_return_from_uniform_p_holm,'
    head += 'score_from_uniform_p_holm\n'
    (tmp_path / 'some' / 'standings.csv').write_text(
        f'{head}Reacher-v5,sum,50,evidence,4,10,-6.04,-7,-5.5,0.98,0.991,13.4,3,11.6,0.0004,0.0312\n'
        'Reacher-v5,sum,50,none,0,10,,,,,,,,,,\n'
    )
    page = (
        'Before.\n<!-- table some -->\nold\n<!-- end -->\nAfter. <!-- table other --> is text.\n'
    )

    filled = tables.filled(page)

    row = '| `evidence` | 4 of 10 | -6.0 (-7.0 to -5.5) | 0.98 | 0.99 | < .001 | 0.031 | 13 |'
    assert f'{row} 12 (3) |' in filled
    assert '`none`' not in filled, 'it has no result'
    assert 'old' not in filled
    assert filled.startswith('Before.\n')
    assert filled.endswith('<!-- end -->\nAfter. <!-- table other --> is text.\n')
    assert tables.filled(filled) == filled
    assert 'Not run yet.' in tables.filled(page.replace('some', 'never'))


def test_what_the_pages_state_of_methods_on_reacher_is_in_the_results() -> None:
    """Where this fails after new runs, read docs/reproduction.md and docs/benchmarks.md again."""
    rows = {row['method']: row for row in tables.rows('reacher_methods')}
    way = {method: float(row['share']) for method, row in rows.items()}
    credit = {method: float(row['within']) for method, row in rows.items() if row['within']}

    assert way['evidence'] > 0.9
    others = way.keys() - {'evidence', 'true'}
    assert 0.4 < max(way[method] for method in others) < 0.6, 'the best comes half of the way'
    assert max(credit[m] for m in credit.keys() - {'evidence', 'true'}) < 0.5
    assert way['ircr'] < way['codetr'] < 0 < way['uniform'] < way['rrd']
    assert way['codetr'] < way['rbt'] < way['uniform']
    assert way['none'] < 0
    for row in tables.rows('reacher_composites'):
        if row['method'] in {'evidence', 'codetr'}:
            assert float(row['share']) > 0.9
        elif row['method'] != 'true':
            assert float(row['share']) < 0.5
