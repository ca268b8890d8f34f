"""Where does every second of a whole run go?

    .venv/bin/python benchmarks/whole_runs.py                 # on an idle machine, half an hour
    .venv/bin/python benchmarks/whole_runs.py -- --config quick --steps 6000

The run is `codetr train`, over topics, with the flags behind `--`: by default those of preset
`cpu`, 100 000 steps of HalfCheetah with CoDeTr and a score every 25 steps. Its stages take turns
(lock-step), so that their seconds add up:
  - start: processes, imports, compiling, discovery, until the first permission to simulate
  - simulate, fit, label, update: what the nodes say they spent on it
  - else: the rest of the run, such as messages on their way, checkpoints, the last evaluation
Evaluation works beside the loop, in a process of its own, and competes for the cores.

Writes `results/whole_runs.md` and `.csv`. To compare, run it at both commits with another `--out`.
"""

import argparse
import csv
import sys
from pathlib import Path

import machine
import throughput

RESULTS = Path(__file__).parent / 'results' / 'whole_runs'
PACKAGES = ('numpy', 'torch', 'mujoco')


def stages(found: dict[str, float]) -> dict[str, float]:
    """Seconds of each stage, from what `throughput.whole_run` says."""
    work = {name.removesuffix('_seconds'): found[name] for name in throughput.WORK}
    return {'start': found['start'], **work, 'else': found['rest'] - sum(work.values())}


def main() -> int:
    """The command line; the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--out', type=Path, default=RESULTS, help='without its suffix')
    parser.add_argument('flags', nargs='*', default=['--config', 'cpu'], metavar='FLAG')
    arguments = parser.parse_args()
    facts = machine.facts(machine.load(), PACKAGES)
    found = throughput.whole_run(arguments.flags, in_process=False)
    seconds, wall = stages(found), found['wall']
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    with arguments.out.with_suffix('.csv').open('w', newline='') as file:
        writer = csv.writer(file)
        writer.writerow(['stage', 'seconds'])
        writer.writerows(
            (name, f'{value:.2f}') for name, value in [*seconds.items(), ('all', wall)]
        )
    lines = [
        '# Where every second of a run goes',
        '',
        '| stage | s | of the run |',
        '|---|---:|---:|',
    ]
    lines += [f'| {name} | {value:.1f} | {value / wall:.3f} |' for name, value in seconds.items()]
    lines += [f'| all | {wall:.1f} | |', '']
    lines += [f'- {name}: {fact}' for name, fact in facts.items()]
    lines.append(f'- run: codetr train {" ".join(arguments.flags)}')
    text = '\n'.join(lines) + '\n'
    arguments.out.with_suffix('.md').write_text(text)
    print(text)
    return 0


if __name__ == '__main__':
    sys.exit(main())
