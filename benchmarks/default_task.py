"""What does credit buy? Every way to share scores out on the default task, ten seeds each.

    .venv/bin/python benchmarks/default_task.py

makes the runs that are still missing, then the table and the picture. With the argument `run`,
`table` or `plot` it does only that. A run is the users' own command, `codetr train`, in process
unless `--over-topics` is given. It leaves one JSON file in `<out>/runs/`; runs with a file there
are not made again.

The variants: `codetr` as shipped; `evidence` alone; `codetr_alone`, the transformer without the
regression below it; `codetr_paper`, the same with all settings of group `codetr` as the paper has
them (its network is sixteen times as wide: five seeds); `none` (the composite reward goes to its
segment's last step, as an agent without redistribution sees it); `uniform` (each step of a
segment gets an equal share); `true` (the environment's own rewards, which no other method sees);
and the uniformly random policy, which each run evaluates once.

The table gives for each of them, over seeds: mean, sample standard deviation, lowest and highest
of the last evaluation's true return and score (1 is an agent that earns the task's largest reward
at every step).

Another task, composite reward or length goes into another folder:

    .venv/bin/python benchmarks/default_task.py --task Pusher-v5 --delay 100 --steps 15000 \\
        --out benchmarks/results/pusher
"""

import argparse
import csv
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import machine
from codetr_ros.config import IN_PROCESS_ONLY, Settings, SettingsError, load
from codetr_ros.runs import references

RESULTS = Path(__file__).parent / 'results' / 'default_task'
METHODS = {
    'codetr': 'CoDeTr as shipped (above evidence)',
    'evidence': 'evidence',
    'true': 'true rewards (oracle)',
    'uniform': 'even spread',
    'codetr_alone': 'CoDeTr alone',
    'codetr_paper': 'CoDeTr alone, as the paper has it',
    'none': 'raw scores',
}
RANDOM = 'random'
STYLES = {  # colour (Okabe and Ito: safe for the colour-blind), marker, line
    'codetr': ('#D55E00', 'o', '-'),
    'evidence': ('#009E73', 'v', '-'),
    'true': ('#000000', 's', '-.'),
    'uniform': ('#0072B2', '^', '-'),
    'codetr_alone': ('#E69F00', 'P', '-'),
    'codetr_paper': ('#56B4E9', 'X', '-'),
    'none': ('#CC79A7', 'D', '-'),
}
SEEDS = tuple(range(10))
FEWER = {'codetr_paper': 5}
"""Seeds of what takes long."""
MEASURES = {'true return': 'final_true_return', 'score': 'final_score'}


def variant(name: str) -> dict[str, Any]:
    """The settings that make it, beyond the preset's."""
    if name == 'codetr_alone':
        return {'method': 'codetr', 'codetr.base': 'none'}
    if name == 'codetr_paper':
        own = load('paper').model_dump()['codetr']
        return {'method': 'codetr', **{f'codetr.{key}': value for key, value in own.items()}}
    return {'method': name}


class ResultsError(ValueError):
    """Results that do not belong together or are not there: names the files and the remedy."""


def changes_of(arguments: argparse.Namespace) -> dict[str, Any]:
    """The settings given on the command line, by name."""
    names = ('task', 'delay', 'composite', 'steps')
    return {n: value for n in names if (value := getattr(arguments, n)) is not None}


def run_one(
    settings: Settings, flags: Sequence[str], path: Path, in_process: bool, measured: str
) -> float:
    """Make one run by the users' own command, and write its results to `path`.

    Args:
        settings: the settings expected from `flags`, to check the run's own.
        flags: the command's flags, except those for the output folder and the process.
        path: the JSON file to make.
        in_process: run without nodes.
        measured: the commit.

    Returns:
        The final true return.

    Raises:
        RuntimeError: the run failed; holds the end of its output.
    """
    words = ['train', '--no-film', *(['--in-process'] if in_process else []), *flags]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder, 'run')
        command = [sys.executable, '-m', 'codetr_ros.cli', *words, '--out', str(out)]
        done = subprocess.run(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
        )
        if done.returncode:
            end = '\n'.join(done.stdout.splitlines()[-30:])
            raise RuntimeError(
                f'codetr {" ".join(words)} ended with exit code {done.returncode}:\n{end}'
            )
        summary = json.loads((out / 'summary.json').read_text())
    if summary['settings_hash'] != settings.hash():
        raise RuntimeError(f'codetr {" ".join(words)} ran with other settings than the given ones')
    keys = ('seed', 'in_process', 'evaluations', 'random', 'final_true_return')
    keys += ('final_score', 'wall_s', 'steps', 'lost', 'refused', 'updates', 'gradient_steps')
    keys += ('policy_sha256', 'versions', 'settings_hash', 'settings')
    result = {
        'variant': path.stem.rpartition('-')[0],
        'command': f'codetr {" ".join(words)}',
        'commit': measured,
        **{key: summary[key] for key in keys},
    }
    partial = path.with_suffix('.partial')
    partial.write_text(json.dumps(result, indent=1) + '\n')
    partial.replace(path)
    return float(summary['final_true_return'])


def run(arguments: argparse.Namespace) -> int:
    """Make the runs that are still missing; returns how many failed."""
    changes, in_process = changes_of(arguments), not arguments.over_topics
    folder = arguments.out / 'runs'
    folder.mkdir(parents=True, exist_ok=True)
    base = load(arguments.config)
    measured = machine.commit()
    jobs: list[tuple[Settings, list[str], Path]] = []
    for seed in arguments.seeds:
        for method in arguments.methods:
            if seed >= FEWER.get(method, len(arguments.seeds)):
                continue
            given = {**changes, **variant(method), 'seed': seed}
            settings = base.changed(given, 'command line')
            flags = ['--config', arguments.config]
            for name, value in given.items():
                flags += _flag(name, value)
            path = folder / f'{method}-{seed}.json'
            if not path.exists():
                jobs.append((settings, flags, path))
                continue
            there = json.loads(path.read_text())
            if (there['settings_hash'], there['in_process']) != (settings.hash(), in_process):
                raise ResultsError(
                    f'{path} was run with other settings ({there["command"]}): choose another '
                    'folder with --out, or remove it'
                )

    def job(settings: Settings, flags: list[str], path: Path) -> bool:
        began = time.monotonic()
        try:
            final = run_one(settings, flags, path, in_process, measured)
        except RuntimeError as error:
            print(error, file=sys.stderr, flush=True)
            return False
        print(f'{path.stem}: {final:.1f} in {time.monotonic() - began:.0f} s', flush=True)
        return True

    print(f'{len(jobs)} runs to make, {arguments.workers} at a time', flush=True)
    with ThreadPoolExecutor(arguments.workers) as pool:
        futures = [pool.submit(job, *each) for each in jobs]
        try:
            good = [future.result() for future in futures]
        except KeyboardInterrupt:
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    return good.count(False)


def _flag(name: str, value: Any) -> list[str]:
    flag = f'--{name.replace("_", "-")}'
    if isinstance(value, bool):
        return [flag if value else f'--{name.rpartition(".")[0]}.no-{flag.rpartition(".")[2]}']
    return [flag, str(value)]


def read_runs(out: Path) -> list[dict[str, Any]]:
    """All runs of a folder, by method and seed.

    Raises:
        ResultsError: there is none, or they differ in more than method and seed.
    """
    paths = sorted((out / 'runs').glob('*.json'))
    if not paths:
        raise ResultsError(f'there is no run in {out / "runs"}: make some with `run`')
    runs = [json.loads(path.read_text()) for path in paths]
    for path, one in zip(paths, runs, strict=True):
        for key, value in one['settings'].items():
            other = runs[0]['settings'][key]
            if key not in ('method', 'seed', 'codetr') and value != other:
                raise ResultsError(
                    f'{path} has {key} = {value}, {paths[0]} has {other}: results of different '
                    'settings belong in different folders (--out)'
                )
        if one['in_process'] != runs[0]['in_process']:
            raise ResultsError(
                f'one of {path} and {paths[0]} ran in process and the other over topics: keep '
                'them in different folders (--out)'
            )
    order = list(METHODS)
    return sorted(runs, key=lambda one: (order.index(one['variant']), one['seed']))


def by_method(runs: list[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """Runs by variant, in the order of METHODS."""
    runs_of: dict[str, list[dict[str, Any]]] = {}
    for one in runs:
        runs_of.setdefault(one['variant'], []).append(one)
    return runs_of


def random_of(runs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The random policy, once for each seed: it is the same beside every method."""
    by_seed = {one['seed']: one['random'] for one in runs if one['random']}
    return [
        {
            'seed': seed,
            'final_true_return': r['true_return_mean'],
            'final_score': r['score_mean'],
            'evaluations': [],
        }
        for seed, r in sorted(by_seed.items())
    ]


def spread(values: Sequence[float]) -> dict[str, float | None]:
    """Mean, sample standard deviation (None for a single value), lowest and highest."""
    return {
        'mean': statistics.fmean(values),
        'sd': statistics.stdev(values) if len(values) > 1 else None,
        'min': min(values),
        'max': max(values),
    }


def table(arguments: argparse.Namespace) -> None:
    """Write `table.csv` and `table.md`."""
    runs = read_runs(arguments.out)
    settings = runs[0]['settings']
    rows: list[dict[str, Any]] = []
    for method, some in [*by_method(runs).items(), (RANDOM, random_of(runs))]:
        if not some:
            continue
        row: dict[str, Any] = {'method': method, 'seeds': len(some)}
        for measure, key in MEASURES.items():
            for statistic, value in spread([one[key] for one in some]).items():
                digits = 1 if measure == 'true return' else 4
                text = '' if value is None else f'{value:.{digits}f}'
                row[f'{measure.replace(" ", "_")}_{statistic}'] = text
        row['true_returns_by_seed'] = ' '.join(f'{one["final_true_return"]:.1f}' for one in some)
        walls = [one['wall_s'] for one in some if 'wall_s' in one]
        row['wall_s_mean'] = f'{statistics.fmean(walls):.1f}' if walls else ''
        row['commits'] = ' '.join(sorted({one['commit'] for one in some if 'commit' in one}))
        rows.append(row)
    with (arguments.out / 'table.csv').open('w', newline='') as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator='\n')
        writer.writeheader()
        writer.writerows(rows)
    way = 'in process' if runs[0]['in_process'] else 'over topics'
    lines = [
        f'{settings["task"]}, {settings["composite"]} over {settings["delay"]} steps, '
        f'{settings["steps"]} steps, {way}. Last evaluation, '
        f'{settings["evaluate_episodes"]} episodes for each seed.',
        '',
    ]
    head = ['method', 'seeds', 'true return: mean ± sd', 'min ... max', 'score: mean ± sd']
    lines += [f'| {" | ".join(head)} |', '|---|' + '---:|' * 4]
    for row in rows:
        cells = [METHODS.get(row['method'], 'random policy'), str(row['seeds'])]
        cells.append(_with_sd(row, 'true_return'))
        cells.append(f'{row["true_return_min"]} ... {row["true_return_max"]}')
        cells.append(_with_sd(row, 'score'))
        lines.append(f'| {" | ".join(cells)} |')
    text = '\n'.join(lines) + '\n'
    (arguments.out / 'table.md').write_text(text)
    print(text, end='')


COMPARED = {
    *('task', 'composite', 'beta', 'delay', 'steps', 'phase_steps', 'warmup_steps', 'overlap'),
    *('simulators', 'envs', 'memory_steps', 'score_missing', 'score_noise', 'score_levels', 'sac'),
}
"""Settings that a run must share with these to be shown beside them."""
SHOWN = {'uniform': 'an even spread', 'none': 'raw scores'}
RECORDED = Path(references.__file__).parent / 'recorded' / 'default_task.json'


def record(arguments: argparse.Namespace) -> None:
    """Write the curves that runs of the default task show beside their own."""
    runs = by_method(read_runs(arguments.out))
    curves = []
    for name, label in SHOWN.items():
        at: dict[int, list[float]] = {}
        for one in runs[name]:
            for evaluation in one['evaluations']:
                at.setdefault(evaluation['step'], []).append(evaluation['true_return_mean'])
        steps = sorted(at)
        curves.append(
            references.Curve(
                label=label,
                seeds=len(runs[name]),
                steps=steps,
                mean=[round(statistics.fmean(at[step]), 2) for step in steps],
                low=[round(min(at[step]), 2) for step in steps],
                high=[round(max(at[step]), 2) for step in steps],
            )
        )
    own = runs['uniform'][0]
    made = references.References(
        settings={name: own['settings'][name] for name in sorted(COMPARED)},
        commit=own['commit'],
        curves=curves,
    )
    RECORDED.write_text(made.model_dump_json(indent=1) + '\n')


def _with_sd(row: dict[str, Any], measure: str) -> str:
    sd = row[f'{measure}_sd']
    return row[f'{measure}_mean'] + (f' ± {sd}' if sd else '')


def plot(arguments: argparse.Namespace) -> None:
    """Draw `learning_curves.png`: mean, lowest and highest seed of each method."""
    import matplotlib

    matplotlib.use('Agg')
    import matplotlib.pyplot as plt

    runs = read_runs(arguments.out)
    settings = runs[0]['settings']
    figure, axes = plt.subplots(figsize=(8, 4.8), layout='constrained')
    # CoDeTr last, so that nothing hides it
    for method, some in reversed(by_method(runs).items()):
        at: dict[int, list[float]] = {}
        for one in some:
            for evaluation in one['evaluations']:
                at.setdefault(evaluation['step'], []).append(evaluation['true_return_mean'])
        steps = sorted(at)
        colour, marker, style = STYLES[method]
        axes.plot(
            steps,
            [statistics.fmean(at[s]) for s in steps],
            style,
            color=colour,
            marker=marker,
            markersize=6 if method == 'codetr' else 5,
            linewidth=2.8 if method == 'codetr' else 1.7,
            label=METHODS[method],
        )
        lowest, highest = [min(at[s]) for s in steps], [max(at[s]) for s in steps]
        axes.fill_between(steps, lowest, highest, color=colour, alpha=0.13, linewidth=0)
    if random := [one['final_true_return'] for one in random_of(runs)]:
        level = statistics.fmean(random)
        axes.axhline(level, color='#777777', linestyle='--', linewidth=1.7, label='random policy')
    seeds = {len(some) for some in by_method(runs).values()}
    counted = f'{min(seeds)} to {max(seeds)}' if len(seeds) > 1 else str(min(seeds))
    axes.set_title(
        f'{settings["task"]}: one {settings["composite"]} reward for every {settings["delay"]} '
        f'steps\nmean, lowest and highest of {counted} seeds',
        fontsize=11,
    )
    episodes = settings['evaluate_episodes']
    axes.set(xlabel='environment steps', ylabel=f'true return ({episodes} episodes)')
    axes.xaxis.set_major_formatter(lambda x, _: f'{x:,.0f}'.replace(',', ' '))
    axes.yaxis.set_major_formatter(lambda y, _: f'{y:,.0f}'.replace(',', ' '))
    axes.set_xlim(left=0)
    axes.grid(alpha=0.25)
    axes.spines[['top', 'right']].set_visible(False)
    handles, labels = axes.get_legend_handles_labels()
    order = [labels.index(n) for n in (*METHODS.values(), 'random policy') if n in labels]
    figure.legend(
        [handles[i] for i in order],
        [labels[i] for i in order],
        loc='outside lower center',
        ncols=3,
        frameon=False,
    )
    figure.savefig(arguments.out / 'learning_curves.png', dpi=150)
    plt.close(figure)


def parse(given: Sequence[str] | None) -> argparse.Namespace:
    """The command line's arguments, checked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('what', nargs='?', default='all', choices=['all', 'run', 'table', 'plot'])
    parser.add_argument('--seeds', type=int, nargs='+', default=list(SEEDS))
    parser.add_argument('--methods', nargs='+', choices=list(METHODS))
    parser.add_argument('--workers', type=int, default=1, help='runs at a time')
    parser.add_argument(
        '--over-topics', action='store_true', help='run with nodes, not in process'
    )
    parser.add_argument('--config', default='quick', help='preset or YAML file')
    parser.add_argument('--task')
    parser.add_argument('--delay', type=int)
    parser.add_argument('--composite')
    parser.add_argument('--steps', type=int)
    parser.add_argument('--out', type=Path, default=RESULTS)
    arguments = parser.parse_args(given)
    if arguments.workers < 1:
        parser.error(f'--workers {arguments.workers}: at least 1')
    hidden = [m for m in METHODS if arguments.over_topics and m in IN_PROCESS_ONLY]
    if wrong := [m for m in arguments.methods or () if m in hidden]:
        parser.error(f'--methods {" ".join(wrong)}: in process only, not with --over-topics')
    arguments.methods = arguments.methods or [m for m in METHODS if m not in hidden]
    differs = changes_of(arguments) or arguments.config != 'quick' or arguments.over_topics
    if differs and arguments.out.resolve() == RESULTS.resolve():
        parser.error(f'{RESULTS.name}/ is for the default task: choose another folder with --out')
    return arguments


def main(given: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    arguments = parse(given)
    failed = 0
    try:
        if arguments.what in ('all', 'run'):
            failed = run(arguments)
        if arguments.what in ('all', 'table'):
            table(arguments)
            if arguments.out.resolve() == RESULTS.resolve():
                record(arguments)
        if arguments.what in ('all', 'plot'):
            plot(arguments)
    except (ResultsError, SettingsError) as error:
        print(f'{os.path.basename(__file__)}: {error}', file=sys.stderr)
        return 2
    if failed:
        print(f'{failed} runs failed; the same command makes them again', file=sys.stderr)
    return 1 if failed else 0


if __name__ == '__main__':
    sys.exit(main())
