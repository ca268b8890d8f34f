"""The CSV files of a report, which hold every number of its tables."""

import csv
import io
from collections.abc import Sequence
from typing import Any

from codetr_ros.benchmark.results import Result
from codetr_ros.benchmark.standings import MEASURES, REFERENCES, Standing
from codetr_ros.benchmark.table import Row


def table(rows: Sequence[Row]) -> str:
    """A line for each method in each row, over several delays and for each delay alone."""
    lines: list[dict[str, Any]] = []
    for row in rows:
        for entry in row.entries:
            low, high = entry.interval or (None, None)
            lines.append(
                {
                    'task': row.task,
                    'composite': row.composite,
                    'delays': ' '.join(map(str, row.delays)),
                    'method': entry.method,
                    'score_mean': entry.mean,
                    'score_spread': entry.spread,
                    'score_iqm': entry.iqm,
                    'score_iqm_low': low,
                    'score_iqm_high': high,
                    'return_mean': entry.return_mean,
                    'return_spread': entry.return_spread,
                    'best': int(entry.best),
                    'bold': int(entry.bold),
                    'p': entry.p,
                    'pairs': entry.pairs,
                    'cells': len(entry.scores),
                    'cells_planned': entry.planned,
                    'cells_failed': entry.failed,
                }
            )
    return _csv(lines)


def cells(results: Sequence[Result]) -> str:
    """A line for each cell, whatever its state."""
    return _csv(
        [
            {
                'cell': r.cell,
                'task': r.task,
                'composite': r.composite,
                'delay': r.delay,
                'method': r.method,
                'seed': r.seed,
                'state': r.state,
                'score': r.score,
                'true_return': r.true_return,
                'within_pearson': _last_within(r),
                'wall_s': r.summary.wall_s if r.summary else None,
                'cpu_s': r.summary.spent[-1].cpu_s if r.summary and r.summary.spent else None,
                'commit': r.commit,
                'error': r.error,
            }
            for r in results
        ]
    )


def evaluations(results: Sequence[Result]) -> str:
    """A line for each evaluation of each finished cell, that of the random policy first."""
    lines = []
    for r in results:
        credit = {row.step: row.within for row in r.reward_recovery}
        spent = {row.step: row.cpu_s for row in r.summary.spent} if r.summary else {}
        for row in r.summary.evaluated() if r.summary else ():
            lines.append(
                {
                    'cell': r.cell,
                    'step': row.step,
                    'score': row.score_mean,
                    'true_return': row.true_return_mean,
                    'within_pearson': credit.get(row.step),
                    'cpu_s': spent.get(row.step),
                }
            )
    return _csv(lines) if lines else ''


def standings(rows: Sequence[Standing]) -> str:
    """A line for each method of each task, composite reward and delay."""
    lines = []
    for row in rows:
        task, composite, delay = row.place
        line: dict[str, Any] = {
            'task': task,
            'composite': composite,
            'delay': delay,
            'method': row.method,
            'seeds': row.seeds,
            'planned': row.planned,
        }
        for name, middle in (('return', row.returns), ('score', row.scores)):
            line[f'{name}_iqm'] = middle.iqm if middle else None
            line[f'{name}_low'] = middle.low if middle else None
            line[f'{name}_high'] = middle.high if middle else None
        line |= {
            'share': row.share,
            'within': row.within,
            'cpu_s': row.cpu_s,
            'reached': row.reached,
            'cpu_s_to': row.cpu_s_to,
        }
        for reference in REFERENCES:
            for measure in MEASURES:
                of = row.against.get((reference, measure))
                name = f'{measure}_from_{reference}'
                line[name] = of.mean if of else None
                line[f'{name}_pairs'] = of.pairs if of else None
                line[f'{name}_p'] = of.p if of else None
                line[f'{name}_p_holm'] = of.corrected if of else None
        lines.append(line)
    return _csv(lines)


def _last_within(result: Result) -> float | None:
    rows = result.reward_recovery
    return rows[-1].within if rows else None


def _csv(lines: Sequence[dict[str, Any]]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, list(lines[0]), lineterminator='\n')
    writer.writeheader()
    for line in lines:
        writer.writerow({k: repr(v) if isinstance(v, float) else v for k, v in line.items()})
    return text.getvalue()
