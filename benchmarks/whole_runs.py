"""Where does every second of a whole run go?

    .venv/bin/python benchmarks/whole_runs.py                 # on an idle machine, half an hour
    .venv/bin/python benchmarks/whole_runs.py -- --config quick --steps 6000

The run is `codetr train`, over topics, with the flags after `--`: by default those of preset
`cpu`, 100 000 steps of HalfCheetah with CoDeTr and a score every 25 steps. Its stages take turns
(lock-step), so that their seconds add up:
  - start: processes, imports, compiling, discovery, until the first permission to simulate
  - simulate, fit, label, update: the times that the nodes report
  - else: the rest of the run, such as messages on their way, checkpoints, the last evaluation
Evaluation works beside the loop, in a process of its own, and competes for the cores.

Writes `results/whole_runs.md` and `.csv`. To compare with another state of this program, check
that out elsewhere, and run it with the same packages:

    .venv/bin/python benchmarks/whole_runs.py --checkout /tmp/earlier --out whole_runs_before
"""

import argparse
import csv
import os
import sys
from pathlib import Path

import machine
import throughput

RESULTS = Path(__file__).parent / 'results'
PACKAGES = ('numpy', 'torch', 'mujoco')
LIBRARIES = ('codetr_ros', 'sim_node', 'reward_node', 'learner_node')


def stages(times: dict[str, float]) -> dict[str, float]:
    """Seconds of each stage, from the times of `throughput.whole_run`."""
    work = {name.removesuffix('_seconds'): times[name] for name in throughput.WORK}
    return {'start': times['start'], **work, 'else': times['rest'] - sum(work.values())}


def environment(checkout: Path) -> dict[str, str]:
    """The variables with which Python finds a checkout's packages before those installed."""
    folders = [str(checkout / name) for name in LIBRARIES]
    others = filter(None, [os.environ.get('PYTHONPATH')])
    return os.environ | {'PYTHONPATH': os.pathsep.join([*folders, *others])}


def main() -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--out', default='whole_runs', help='name of the results')
    parser.add_argument('--checkout', type=Path, help='folder of the checkout to run')
    parser.add_argument('flags', nargs='*', default=['--config', 'cpu'], metavar='FLAG')
    arguments = parser.parse_args()
    facts = machine.facts(machine.load(), PACKAGES)
    variables = None
    if arguments.checkout:
        facts['commit of the run'] = machine.commit(arguments.checkout)
        variables = environment(arguments.checkout.absolute())
    times = throughput.whole_run(arguments.flags, in_process=False, environment=variables)
    seconds, wall = stages(times), times['wall']
    with (RESULTS / f'{arguments.out}.csv').open('w', newline='') as file:
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
    (RESULTS / f'{arguments.out}.md').write_text(text)
    print(text)
    return 0


if __name__ == '__main__':
    sys.exit(main())
