"""The report of a benchmark: one page with tables and pictures, in HTML and Markdown, and CSV."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from codetr_ros.benchmark import anchors as trivial
from codetr_ros.benchmark import curves, files, scores, sections, standing_rows, table
from codetr_ros.benchmark.folder import Folder
from codetr_ros.benchmark.results import Result, read
from codetr_ros.benchmark.standings import standings
from codetr_ros.config import delay_in_words
from codetr_ros.runs.document import Block, Heading, markdown, page, plain
from codetr_ros.simulation import tasks
from codetr_ros.system.files import atomic_write

REPORT = 'report'


def write(paths: Sequence[Path], out: Path | None = None) -> tuple[Path, str]:
    """Report on benchmarks.

    Args:
        paths: their folders.
        out: folder of the report; by default `report` in the first folder.

    Returns:
        The report's folder, and its scores and returns as text for a terminal.

    Raises:
        BenchmarkError: a folder is not a benchmark's, or the benchmarks cannot be compared.
        TaskError: a task cannot be made to simulate its trivial anchors.
    """
    results = read(paths)
    first = Folder(paths[0])
    folder = out or first.path / REPORT
    folder.mkdir(parents=True, exist_ok=True)
    anchors = trivial.anchors(results, first.path / trivial.FILE)
    pictures = dict(_pictures(results, anchors))
    for name, picture in pictures.items():
        atomic_write(folder / name, picture)
    r_max = _r_max(results)
    together, alone = table.rows(results)
    # lengths that are drawn and whole episodes are in no mean over delays
    each = [*together, *(row for row in alone if isinstance(row.delays[0], str))]
    in_span, _ = table.rows(results, table.TABLE_DELAYS)
    head: list[Block] = [Heading(sections.title(results), 1), *sections.protocol(results, r_max)]
    numbers: list[Block] = [
        *scores.own(together, alone, anchors),
        *scores.returns(together, alone),
    ]
    standing = standings(results, anchors)
    beside = scores.beside_the_paper(in_span)
    blocks: list[Block] = [
        *head,
        *standing_rows.blocks(standing),
        *numbers,
        *scores.interquartile(table.aggregate(each), each),
        *scores.anchors(anchors),
        *sections.recovery(results),
        *sections.pictures(pictures),
        *sections.unfinished(results),
        *beside,
        *sections.differences(results, r_max),
        *sections.settings(results),
        *sections.sessions(paths),
    ]
    atomic_write(folder / 'table.md', markdown(blocks))
    atomic_write(folder / 'index.html', page(blocks))
    several = [row for row in together if len(row.delays) > 1]
    atomic_write(folder / 'table.csv', files.table([*several, *alone]))
    atomic_write(folder / 'standings.csv', files.standings(standing))
    atomic_write(folder / 'cells.csv', files.cells(results))
    atomic_write(folder / 'evaluations.csv', files.evaluations(results))
    return folder, plain([*head, *numbers, *beside])


def _r_max(results: Sequence[Result]) -> dict[str, float]:
    return {r.task: r.settings['r_max'] or tasks.find(r.task).r_max for r in results}


def _pictures(results: Sequence[Result], anchors: trivial.Anchors) -> Iterator[tuple[str, bytes]]:
    """Yield each picture with its file name."""
    order = table.methods(results)
    for key, numbers in anchors.items():
        some = [r for r in results if (r.task, r.composite, r.delay) == key]
        name = some[0].cell.split(f'_{some[0].method}_seed')[0]
        seeds = len({result.seed for result in some if result.summary})
        task, composite, delay = key
        what = f'{task}: {composite} of {delay_in_words(delay)}'
        title = f'{what}; mean and range over seeds ({seeds})'
        yield f'learning_{name}.png', curves.learning_curves(some, order, numbers, title)
        picture = curves.recovery_curves(some, order, f'Reward recovery. {title}')
        if picture is not None:
            yield f'recovery_{name}.png', picture
