"""Does a run whose nodes are killed end as if nothing had happened?

    .venv/bin/python benchmarks/kills.py [--runs N]

Small runs over topics, in lock-step and with overlap, by three methods. In each, nodes are killed
by a schedule that its seed draws: which, how many at once, in which phase and how long after its
beginning, twice in a row now and then. The digests of policy and reward model are compared with
those of the same run undisturbed. A row for each run; one that is in the file is not made again.
"""

import argparse
import json
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import yaml
from rows import Rows

sys.path.insert(0, str(Path(__file__).parent.parent / 'tests'))
from helpers.builders import tiny

OUT = Path(__file__).parent / 'results' / 'kills.csv'
COLUMNS = ('method', 'overlap', 'seed', 'kills', 'schedule', 'exit_code', 'seconds', 'same')
KINDS = [(method, overlap) for method in ('codetr', 'rrd', 'none') for overlap in (False, True)]
CODETR = Path(sys.prefix) / 'bin' / 'codetr'
STEPS, PHASES = 2000, 10
LONGEST = 600.0  # [s] for a run


def nodes(folder: Path) -> dict[str, int]:
    """Ids of the processes of a run, by role."""
    found = {}
    for place in Path('/proc').glob('[0-9]*'):
        try:
            words = (place / 'cmdline').read_bytes().decode(errors='replace').split('\0')
        except OSError:
            continue
        if any(str(folder) in word for word in words):
            for word in words:
                if match := re.search(r'/lib/\w+/(sim|evaluate|reward|learner|record)$', word):
                    found[match[1]] = int(place.name)
    return found


def phase_of(folder: Path) -> int:
    """Phases that are recorded so far, by the recorder's log; -1 before it began."""
    log = folder / 'logs' / 'record.log'
    said = log.read_text() if log.is_file() else ''
    done = re.findall(r'phase (\d+) of', said)
    return int(done[-1]) if done else 0 if 'everybody is there' in said else -1


def schedule(seed: int, roles: list[str]) -> list[tuple[int, float, list[str]]]:
    """What is killed: from which phase on, how many seconds later, which roles."""
    rng = random.Random(seed)
    planned = []
    for phase in sorted(rng.sample(range(-1, PHASES), rng.randint(2, 4))):
        some = rng.sample(roles, rng.choice((1, 1, 1, 2, len(roles))))
        planned.append((phase, rng.uniform(0, 1.5), some))
        if rng.random() < 0.25:  # twice in a row
            planned.append((phase, rng.uniform(0, 8), some))
    return planned


def run(folder: Path, config: Path, planned: list[tuple[int, float, list[str]]]) -> tuple:
    """Do a run; kills, exit code, seconds and digests."""
    began, kills = time.monotonic(), 0
    flags = ['--no-film', '--restarts', '1000', '--peer-deadline', '300']
    with (folder.with_suffix('.log')).open('w') as log:
        command = subprocess.Popen(
            [CODETR, 'train', '--config', config, '--out', folder, *flags],
            stdout=log, stderr=subprocess.STDOUT,
        )  # fmt: skip
        todo = list(planned)
        while command.poll() is None and time.monotonic() - began < LONGEST:
            time.sleep(0.02)
            if todo and phase_of(folder) >= todo[0][0] and nodes(folder):
                _, after, roles = todo.pop(0)
                time.sleep(after)
                there = nodes(folder)
                for role in roles:
                    if role in there:
                        try:
                            os.kill(there[role], signal.SIGKILL)
                            kills += 1
                        except ProcessLookupError:
                            pass
        if command.poll() is None:
            command.send_signal(signal.SIGINT)
        code = command.wait()
    summary = folder / 'summary.json'
    made = json.loads(summary.read_text()) if summary.is_file() else {}
    digests = made.get('policy_sha256'), made.get('reward_model_sha256')
    return kills, code, time.monotonic() - began, digests


def main() -> None:
    """Make all rows that are lacking."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--runs', type=int, default=6, help='runs, all kinds in turn')
    given = parser.parse_args()
    rows = Rows(OUT, COLUMNS, 3)
    undisturbed: dict[tuple[str, bool], tuple] = {}
    for number in range(given.runs):
        method, overlap = kind = KINDS[number % len(KINDS)]
        if (method, overlap, number) in rows:
            continue
        settings = tiny(method=method, overlap=overlap, steps=STEPS)
        with tempfile.TemporaryDirectory(prefix='codetr-kills-') as place:
            config = Path(place) / 'config.yaml'
            config.write_text(yaml.safe_dump(settings.model_dump(mode='json')))
            if kind not in undisturbed:
                *_, undisturbed[kind] = run(Path(place) / 'undisturbed', config, [])
            planned = schedule(number, list(settings.roles))
            kills, code, seconds, digests = run(Path(place) / 'run', config, planned)
        shown = ' '.join(f'{p}+{after:.1f}:{"+".join(roles)}' for p, after, roles in planned)
        same = digests == undisturbed[kind] and code == 0
        rows.append((method, overlap, number, kills, shown, code, f'{seconds:.0f}', same))


if __name__ == '__main__':
    main()
