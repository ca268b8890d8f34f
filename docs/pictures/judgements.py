"""Draw what judgements are worth: judgements.png, from the rows of benchmarks/people.py.

    .venv/bin/python docs/pictures/judgements.py

A line for each task: the mean over seeds of the share of the way from the random policy to the
oracle of the same seed (that of seed 0 where it is not there). The band is from the worst seed to
the best one. Rows of several people, and of preferences, are left to the tables.
"""

import csv
from collections import defaultdict
from pathlib import Path
from statistics import fmean
from typing import Any

from codetr_ros.runs import pictures

HERE = Path(__file__).resolve().parent
ROWS = HERE.parent.parent / 'benchmarks' / 'results' / 'people.csv'
PICTURE = HERE / 'judgements.png'
COLOURS = (pictures.TRUE, pictures.INFERRED, '#2e7d4f')
GOAL = 90

Shares = dict[str, dict[int, list[float]]]
"""Task -> judgements -> the share [%] of each seed."""


def shares(rows: list[dict[str, str]]) -> Shares:
    """How far the runs of one person who scores got."""
    oracles = {(r['task'], r['seed']): float(r['final']) for r in rows if r['budget'] == 'oracle'}
    found: Shares = defaultdict(lambda: defaultdict(list))
    for row in rows:
        if row['budget'] == 'oracle' or float(row['preferences']) or row['people'] != '1':
            continue
        random, task = float(row['random']), row['task']
        best = oracles.get((task, row['seed']), oracles[task, '0'])
        share = 100 * (float(row['final']) - random) / (best - random)
        found[task][int(row['budget'])].append(share)
    return found


def draw(found: Shares) -> bytes:
    """The picture, as a PNG."""

    def fill(figure: Any) -> None:
        axes = figure.subplots()
        budgets = sorted({budget for of_task in found.values() for budget in of_task})
        for (task, of_task), colour in zip(sorted(found.items()), COLOURS, strict=True):
            known = sorted(of_task)
            worst, best = ([end(of_task[n]) for n in known] for end in (min, max))
            axes.fill_between(known, worst, best, color=colour, alpha=0.15, linewidth=0)
            seeds = [len(of_task[n]) for n in known]
            many = str(min(seeds)) if min(seeds) == max(seeds) else f'{min(seeds)} to {max(seeds)}'
            label = f'{task}, seeds: {many}'
            means = [(float(n), fmean(of_task[n])) for n in known]
            pictures.line(axes, means, label, colour)
        axes.axhline(100, color=pictures.GREY, linewidth=1)
        axes.axhline(GOAL, color=pictures.GREY, linewidth=1, linestyle='--')
        axes.set_xscale('log', base=2)
        axes.set_xticks(budgets, [str(budget) for budget in budgets])
        axes.minorticks_off()
        axes.set_xlabel('judgements of a simulated person in the whole run')
        axes.set_ylabel('way from the random policy\nto true rewards (%)')
        axes.grid(alpha=0.3)
        axes.spines[['top', 'right']].set_visible(False)
        axes.set_ylim(bottom=min(0, axes.get_ylim()[0]))
        figure.legend(loc='outside upper center', ncols=3, frameon=False, fontsize=8)

    return pictures.png((pictures.WIDE, 3.6), fill)


def main() -> None:
    """Draw the picture."""
    with ROWS.open() as file:
        PICTURE.write_bytes(draw(shares(list(csv.DictReader(file)))))


if __name__ == '__main__':
    main()
