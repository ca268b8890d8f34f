"""Do simulated runs end as if nothing had happened, or by a named cause, for very many seeds?

    .venv/bin/python benchmarks/simtest_seeds.py [--begin A] [--end B] [--block N] [--losing]

The seeds from A up to B - 1, as `codetr simtest --seeds` simulates them, in blocks. A row for each
block, with the commit and the versions that it was made with; one that is in the file, of the same
commit, is not made again. So it goes on after it was ended, and several may run at once with other
ranges. Exit code 1: a seed failed; `codetr simtest --seed N --trace` shows it.

With `--losing`, a fifth of all messages, questions and answers is lost on every way instead, and
nodes are killed (`simtest/losing.py`). A run that ends by a named cause has failed, too.
"""

import argparse
import gc
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from rows import Rows

from codetr_ros.simtest.losing import losing
from codetr_ros.simtest.plan import Plan, plan
from codetr_ros.simtest.run import carry_out
from codetr_ros.system.versions import version_of

RESULTS = Path(__file__).parent / 'results'
OUT, OUT_LOSING = RESULTS / 'simtest_seeds.csv', RESULTS / 'simtest_losing.csv'
COLUMNS = (
    'first', 'last', 'commit', 'seconds', 'failed', 'mended', 'ended_by_name', 'seeds_failed',
    'codetr_ros', 'python', 'torch', 'machine',
)  # fmt: skip
KEYS = 3


def commit() -> str:
    """The commit of the program, with a `+` if files differ from it."""
    where = Path(__file__).parent
    git = ['git', '-C', str(where)]
    name = subprocess.run(
        [*git, 'rev-parse', '--short=12', 'HEAD'], check=False, capture_output=True, text=True
    )
    changed = ['diff', '--quiet', 'HEAD', '--', ':!results']
    dirty = subprocess.run([*git, *changed], check=False).returncode
    return (name.stdout.strip() or 'unknown') + '+' * bool(dirty)


def block(first: int, last: int, drawn: Callable[[int], Plan]) -> tuple[object, ...]:
    """Simulate what is drawn from some seeds; the columns from `seconds` to `seeds_failed`."""
    began, failed, mended, by_name = time.perf_counter(), [], 0, 0
    for seed in range(first, last + 1):
        outcome = carry_out(drawn(seed))
        by_name += bool(outcome.errors)
        mended += not outcome.errors and not outcome.plan.calm
        if outcome.failures:
            failed.append(str(seed))
            print(f'seed {seed}: {outcome.failures[0]}', flush=True)
    seconds = time.perf_counter() - began
    return round(seconds, 1), len(failed), mended, by_name, ' '.join(failed)


def main(arguments: list[str] | None = None, out: Path | None = None) -> int:
    """Simulate what is lacking; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('--begin', type=int, default=0)
    parser.add_argument('--end', type=int, default=100_000)
    parser.add_argument('--block', type=int, default=500)
    parser.add_argument('--losing', action='store_true')
    given = parser.parse_args(arguments)
    if not 0 <= given.begin < given.end or given.block < 1:
        parser.error('--begin must be less than --end, and --block at least 1')
    out = out or (OUT_LOSING if given.losing else OUT)
    drawn = losing if given.losing else plan
    rows, made = Rows(out, COLUMNS, KEYS), commit()
    versions = (
        version_of('codetr_ros'), platform.python_version(), version_of('torch'),
        platform.machine(),
    )  # fmt: skip
    failed = 0
    for first in range(given.begin, given.end, given.block):
        last = min(first + given.block, given.end) - 1
        if (first, last, made) in rows:
            continue
        row = block(first, last, drawn)
        rows.append((first, last, made, *row, *versions))
        failed += int(str(row[1]))
    return 1 if failed else 0


if __name__ == '__main__':
    gc.freeze()  # what is imported need not be looked at again and again
    sys.exit(main())
