"""The machine, versions and commit of a measurement, which stand beside every table here."""

import os
import platform
import statistics
import subprocess
from collections.abc import Iterable, Sequence
from importlib.metadata import version
from pathlib import Path

HERE = Path(__file__).parent
LOUD = 0.5
"""Load average above which a machine is not idle."""


def commit(checkout: Path = HERE) -> str:
    """The measured commit, marked if tracked files other than results have changed.

    `CODETR_COMMIT` names it for a copy without git's folder, on a machine that cannot fetch.
    """
    if checkout == HERE and (given := os.environ.get('CODETR_COMMIT')):
        return given

    def git(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            ['git', *arguments], cwd=checkout, capture_output=True, text=True, check=False
        )

    name = git('describe', '--always', '--exclude', '*').stdout.strip()
    code = git('diff', '--quiet', 'HEAD', '--', ':/', ':(top,exclude)benchmarks/results')
    return name + ('-dirty' if code.returncode else '')


def processor() -> str:
    """The processor's name, as far as the system knows it."""
    if (info := Path('/proc/cpuinfo')).is_file():
        for line in info.read_text().splitlines():
            if line.startswith('model name'):
                return line.split(':')[1].strip()
    return platform.processor() or platform.machine()


def load() -> str:
    """The load average of the last minute, marked if the machine is not idle. Call it first."""
    average = os.getloadavg()[0]
    return f'{average:.2f}' + (' (the machine was NOT idle)' if average > LOUD else '')


def cpu_seconds(process: int) -> float:
    """CPU seconds, of user and system, that a process has used so far.

    Args:
        process: Its number.

    Raises:
        OSError: It has ended.
    """
    stat = Path(f'/proc/{process}/stat').read_text()
    ticks = map(int, stat.rpartition(')')[2].split()[11:13])  # user, system
    return sum(ticks) / os.sysconf('SC_CLK_TCK')


def spread(values: Sequence[float], form: str) -> str:
    """Median [lowest, highest], each formatted by `form`, such as '.2f'."""
    low, middle, high = min(values), statistics.median(values), max(values)
    return f'{middle:{form}} [{low:{form}}, {high:{form}}]'


def facts(load_at_start: str, packages: Iterable[str] = ()) -> dict[str, str]:
    """The facts on which the numbers depend, by name.

    Args:
        load_at_start: The result of `load` before the measurement.
        packages: Distributions whose versions matter.
    """
    return {
        'cpu': processor(),
        'cores': str(len(os.sched_getaffinity(0))),
        'load average at the start': load_at_start,
        'system': platform.platform(),
        'python': platform.python_version(),
        **{name: version(name) for name in packages},
        'commit': commit(),
    }
