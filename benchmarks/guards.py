"""What do the guards of a run cost: digests, signatures, checks, checkpoints?

    .venv/bin/python benchmarks/guards.py                   # on an idle machine, two minutes

One run over topics, as `codetr train` starts it, with a key. In each node the functions below add
up the time that they take (each call about a microsecond more than without). In lock-step one node
works at a time, so the sum over all nodes by the time of the loop (from the first permission to
the last metrics) is the share of the run that they cost, at most: what a node does while it would
have waited counts too.

  - digests: of records, labels, policies and commits (`records.digests`)
  - signatures: of what is published and of what arrives (`nodes.signing`)
  - checks: bounds of what arrives, whose it is, whether it came before
  - kept: what is kept to be sent again
  - checkpoints: of learner and reward node
  - sync: of the bag, before each commit

Writes `results/guards.md`.
"""

import argparse
import atexit
import functools
import importlib
import json
import os
import runpy
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

PARTS = {
    'digests': ('records.digests:raw_digest', 'records.digests:joined'),
    'signatures': ('nodes.signing:signed', 'nodes.signing:is_signed'),
    'checks': (
        'records.bounds:check_bounds',
        'nodes.admission:Admission.admit',
        'nodes.repeats:Repeats.note',
        'nodes.repeats:Repeats.knows',
    ),
    'kept': ('nodes.outbox:Outbox.keep',),
    'checkpoints': ('runs.checkpoints:save',),
    'sync': ('nodes.kept_run:KeptRun.flush',),
}
"""What is timed: module of the library, and function or method."""
RESULTS = Path(__file__).parent / 'results' / 'guards.md'
NODE = '--node'


# ---- in each node


def timed(part: str, function: Callable[..., Any], seconds: Counter[str]) -> Callable[..., Any]:
    """A function that adds up its time."""

    @functools.wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        began = time.perf_counter()
        try:
            return function(*arguments, **named)
        finally:
            seconds[part] += time.perf_counter() - began

    return call


def time_parts(seconds: Counter[str]) -> None:
    """Time all parts from now on. Who imports a function later gets the timed one."""
    before = set(sys.modules)
    for part, places in PARTS.items():
        for place in places:
            module, _, path = place.partition(':')
            holder: Any = importlib.import_module(f'codetr_ros.{module}')
            *outer, name = path.split('.')
            for each in outer:
                holder = getattr(holder, each)
            original = getattr(holder, name)
            made = timed(part, original, seconds)
            for other in [holder, *map(sys.modules.get, set(sys.modules) - before)]:
                if getattr(other, name, None) is original:
                    setattr(other, name, made)


def run_node(out: Path, program: str, arguments: Sequence[str]) -> None:
    """Run a node's program, and write how long each part took."""
    seconds: Counter[str] = Counter()
    time_parts(seconds)
    atexit.register(lambda: out.write_text(json.dumps(seconds)))
    sys.argv = [program, *arguments]
    runpy.run_path(program, run_name='__main__')


# ---- the run


def one_run(config: str, steps: int | None) -> tuple[dict[str, Counter[str]], float, str]:
    """Make a run; seconds of each part by node, seconds of the loop, and the run in words."""
    from recording_overhead import DEADLINE, Clock
    from started import check, first_failure

    from codetr_ros.config import load
    from codetr_ros.nodes import signing
    from codetr_ros.processes import launcher
    from codetr_ros.ros.watch import Watcher
    from codetr_ros.runs import folder as run_folder

    settings = load(config)
    if steps:
        settings = settings.changed({'steps': steps}, 'command line')
    clock, run_id = Clock(settings.phases), f'guards_{os.getpid()}'
    with tempfile.TemporaryDirectory(prefix='codetr-guards-') as where:

        def start(
            arguments: Sequence[str], environment: Mapping[str, str], log: BinaryIO
        ) -> launcher.Process:
            out = Path(where) / f'{Path(arguments[0]).name}.json'
            own = [sys.executable, __file__, NODE, str(out)]
            return launcher.start_program([*own, *arguments], environment, log)

        folder = run_folder.create(Path(where) / 'run')
        run_folder.write_settings(folder, settings)
        variables = launcher.environment(settings) | signing.environment()
        os.environ.update(variables)
        with (
            launcher.Processes(print, start_program=start) as processes,
            Watcher(clock.receive, launcher.namespace_of(run_id)) as watcher,
        ):
            commands = launcher.commands(settings, run_id, folder)
            processes.start(commands, folder / run_folder.LOGS, variables)
            end = time.monotonic() + DEADLINE
            while processes.running() and not first_failure(processes):
                watcher.poll(0.1)
                if time.monotonic() > end:
                    raise SystemExit(f'a run took more than {DEADLINE:g} s')
        check(processes)
        found = sorted(Path(where).glob('*.json'))
        parts = {path.stem: Counter(json.loads(path.read_text())) for path in found}
    if clock.first is None or clock.last is None:
        raise SystemExit('the first commit or the last metrics did not arrive')
    what = f'{config}, {settings.task}, {settings.steps} steps in {settings.phases} phases'
    return parts, clock.last - clock.first, what


def table(parts: Mapping[str, Counter[str]], loop: float, facts: Mapping[str, str]) -> str:
    """Seconds of each part and node, and their share of the loop."""
    lines = [
        '# What the guards of a run cost',
        '',
        f'| part | {" | ".join(f"{name} [s]" for name in parts)} | all [s] | of the loop |',
        '|---|' + '---:|' * (len(parts) + 2),
    ]
    for part in PARTS:
        own = [parts[name][part] for name in parts]
        shown = ' | '.join(f'{seconds:.3f}' for seconds in own)
        lines.append(f'| {part} | {shown} | {sum(own):.3f} | {sum(own) / loop:.2%} |')
    total = sum(seconds.total() for seconds in parts.values())
    lines += ['', f'- all together: {total:.2f} s of {loop:.1f} s, {total / loop:.2%}']
    return '\n'.join([*lines, *(f'- {name}: {fact}' for name, fact in facts.items())]) + '\n'


def main() -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--config', default='quick', help='preset or YAML file')
    parser.add_argument('--steps', type=int, help='of the run; by default as in the config')
    parser.add_argument('--out', type=Path, default=RESULTS)
    given = parser.parse_args()
    import machine

    load_at_start = machine.load()
    parts, loop, what = one_run(given.config, given.steps)
    facts = {'run': what, **machine.facts(load_at_start, ('numpy', 'torch', 'mcap'))}
    text = table(parts, loop, facts)
    print(text, end='')
    given.out.write_text(text)
    return 0


if __name__ == '__main__':
    if sys.argv[1:2] == [NODE]:
        run_node(Path(sys.argv[2]), sys.argv[3], sys.argv[4:])
    else:
        sys.exit(main())
