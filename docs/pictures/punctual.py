"""Draw how late control steps were in an hour: punctual.png, from the phases of that run.

    .venv/bin/python docs/pictures/punctual.py

The rows are the metrics of the robot node after each phase of 1000 steps, in the hour of
`benchmarks/control_loop.py --minutes 60` that is the last row of control_loop.md. Each is of all
control steps since the beginning.
"""

import csv
from pathlib import Path
from typing import Any

from codetr_ros.runs import pictures

HERE = Path(__file__).resolve().parent
ROWS = HERE.parent.parent / 'benchmarks' / 'results' / 'control_loop_hour.csv'
PICTURE = HERE / 'punctual.png'
RATE = 50.0  # [Hz]
LINES = {'late_ms_max': 'the latest so far', 'late_ms_p99.9': '99.9 %', 'late_ms_p50': 'median'}
COLOURS = (pictures.TRUE, pictures.INFERRED, '#2e7d4f')


def draw(rows: list[dict[str, str]]) -> bytes:
    """The picture, as a PNG."""
    minutes = [float(row['control_steps']) / RATE / 60 for row in rows]

    def fill(figure: Any) -> None:
        axes = figure.subplots()
        for (name, label), colour in zip(LINES.items(), COLOURS, strict=True):
            late = [float(row[name]) for row in rows]
            axes.plot(minutes, late, color=colour, label=label)
        axes.axhline(1000 / RATE, color=pictures.GREY, linewidth=1, linestyle='--')
        axes.text(
            0.3, 1060 / RATE, 'one period: a step is missed', color=pictures.GREY, fontsize=8
        )
        axes.set_yscale('log')
        axes.set_xlabel('minutes')
        axes.set_ylabel('late (ms)')
        axes.set_ylim(0.1, 40)
        axes.set_xlim(0, minutes[-1])
        axes.grid(alpha=0.3)
        axes.spines[['top', 'right']].set_visible(False)
        figure.legend(loc='outside upper center', ncols=3, frameon=False, fontsize=8)

    return pictures.png((pictures.WIDE, 3.0), fill)


def main() -> None:
    """Draw the picture."""
    with ROWS.open() as file:
        PICTURE.write_bytes(draw(list(csv.DictReader(file))))


if __name__ == '__main__':
    main()
