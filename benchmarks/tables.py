"""Make the committed results of finished benchmarks, and the tables of the pages about them.

    .venv/bin/python benchmarks/tables.py collect runs     # every runs/NAME of a spec here
    .venv/bin/python benchmarks/tables.py pages            # fill the tables of docs/ in again

`collect` writes the report of each folder below `runs` that is named as a spec in `specs/` into
`results/NAME`, whatever share of its cells is done: `table.md` counts them. `pages` puts the
numbers of `results/*/standings.csv` between the marks `<!-- table NAME -->` and `<!-- end -->` of
the pages. So no number of these tables is copied by hand; a test holds that they are current.
"""

import argparse
import csv
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

HERE = Path(__file__).parent
RESULTS, SPECS = HERE / 'results', HERE / 'specs'
PAGES = HERE.parent / 'docs'
MARKED = re.compile(r'(<!-- table ([a-z0-9_]+) -->\n).*?(<!-- end -->)', re.DOTALL)
NONE = '–'

Row = dict[str, str]

CONDITIONS = {
    'reacher_methods': 'every score, exact',
    'reacher_missing_25': 'a quarter missing',
    'reacher_missing_50': 'half missing',
    'reacher_missing_75': 'three quarters missing',
    'reacher_noise_10': 'noise of .1 deviations',
    'reacher_noise_30': 'noise of .3 deviations',
    'reacher_stars': 'one to five stars',
    'reacher_thumbs': 'thumbs up or down',
}
CONDITION_METHODS = ('evidence', 'codetr', 'uniform', 'none')


def rows(name: str) -> list[Row]:
    """The standings of a benchmark; none if it has not been collected."""
    path = RESULTS / name / 'standings.csv'
    if not path.is_file():
        return []
    with path.open() as file:
        return list(csv.DictReader(file))


def number(text: str, digits: int) -> str:
    """A number of a file for people."""
    return f'{float(text):.{digits}f}' if text else NONE


def p_value(text: str) -> str:
    """A p-value for people."""
    return NONE if not text else '< .001' if float(text) < 0.001 else f'{float(text):.3f}'


def middle(row: Row) -> str:
    """Interquartile mean and interval of the returns."""
    digits = 0 if abs(float(row['return_iqm'])) >= 200 else 1
    of = [number(row[f'return_{name}'], digits) for name in ('iqm', 'low', 'high')]
    return f'{of[0]} ({of[1]} to {of[2]})'


def seeds(row: Row) -> str:
    """How many seeds are done, of how many."""
    return (
        row['seeds'] if row['seeds'] == row['planned'] else f'{row["seeds"]} of {row["planned"]}'
    )


def table(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A table in Markdown, with the first column to the left."""
    ruler = ['---', *['---:'] * (len(head) - 1)]
    return ''.join(f'| {" | ".join(line)} |\n' for line in (head, ruler, *lines))


def standing_table(name: str) -> Iterator[str]:
    """A table for each task, composite reward and delay of a benchmark."""
    every = rows(name)
    places = list(dict.fromkeys((r['task'], r['composite'], r['delay']) for r in every))
    head = ['method', 'seeds', 'true return', 'of the way', 'credit within']
    head += ['p (return)', 'p (score)', 'CPU s', 'CPU s to 80 %']
    for place in places:
        if len(places) > 1:
            yield f'\n{place[0]}, `{place[1]}`, {place[2]}:\n\n'
        yield table(
            head,
            [
                [
                    f'`{r["method"]}`',
                    seeds(r),
                    middle(r),
                    number(r['share'], 2),
                    number(r['within'], 2),
                    p_value(r['true_return_from_uniform_p_holm']),
                    p_value(r['score_from_uniform_p_holm']),
                    number(r['cpu_s'], 0),
                    f'{number(r["cpu_s_to"], 0)} ({r["reached"]})' if r['reached'] else NONE,
                ]
                for r in every
                if r['return_iqm'] and (r['task'], r['composite'], r['delay']) == place
            ],
        )


def condition_table() -> str:
    """Returns and credit by what scores are like: rows of the benchmarks that are there."""
    lines = []
    for name, words in CONDITIONS.items():
        by_method = {r['method']: r for r in rows(name) if r['return_iqm']}
        if not by_method:
            continue
        line = [words, '/'.join(dict.fromkeys(seeds(r) for r in by_method.values()))]
        for method in CONDITION_METHODS:
            # reacher_methods has CoDeTr alone, the others have it above evidence
            row = (
                None if (name, method) == ('reacher_methods', 'codetr') else by_method.get(method)
            )
            within = f', {number(row["within"], 2)}' if row and row['within'] else ''
            line.append(middle(row) + within if row else NONE)
        lines.append(line)
    return table(
        ['scores', 'seeds', '`evidence`', 'CoDeTr above it', 'even spread', 'raw scores'], lines
    )


def text(name: str) -> str:
    """The content of a marked table."""
    made = condition_table() if name == 'conditions' else ''.join(standing_table(name))
    return made.lstrip('\n') or 'Not run yet.\n'


def filled(page: str) -> str:
    """A page with its marked tables filled in."""
    return MARKED.sub(lambda m: m[1] + '\n' + text(m[2]) + '\n' + m[3], page)


def collect(runs: Path) -> None:
    """Write the reports of finished benchmarks into `results`."""
    from codetr_ros.benchmark import report

    for spec in sorted(SPECS.glob('*.yaml')):
        if (runs / spec.stem / 'benchmark.json').is_file():
            out, _ = report.write([runs / spec.stem], RESULTS / spec.stem)
            (out / 'index.html').unlink()
            print(out, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('what', choices=['collect', 'pages'])
    parser.add_argument('runs', type=Path, nargs='?', default=Path('runs'))
    arguments = parser.parse_args()
    if arguments.what == 'collect':
        collect(arguments.runs)
    for page in sorted(PAGES.glob('*.md')):
        before = page.read_text()
        if (after := filled(before)) != before:
            page.write_text(after)
            print(page, flush=True)


if __name__ == '__main__':
    main()
