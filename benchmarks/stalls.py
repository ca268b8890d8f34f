"""Does a run whose nodes are held beyond the lease of the middleware end as if nothing happened?

    .venv/bin/python benchmarks/stalls.py [--seconds S] [--roles ROLE ...]

A small run over topics for each role. Once three phases are committed, the node of the role is
held (SIGSTOP) for so many seconds: longer than the 20 s after which others take it for gone, so
that all must find each other again. Where the default peer deadline of 60 s is too short, it is
twice that time. The digests of policy and reward model are compared with those of the same run in
process. `logged` is what another node has logged of it meanwhile. A row for each role; one that is
in the file is not made again.
"""

import argparse
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import yaml
from kills import CODETR, nodes, phase_of
from rows import Rows

sys.path.insert(0, str(Path(__file__).parent.parent / 'tests'))
from codetr_ros.bags.verify import verify
from codetr_ros.cli.train_flags import PEER_DEADLINE
from codetr_ros.cores import in_process
from helpers.builders import tiny

OUT = Path(__file__).parent / 'results' / 'stalls.csv'
COLUMNS = ('role', 'held', 'exit_code', 'seconds', 'same', 'sound', 'lost', 'logged')
SETTINGS = tiny(steps=2400)
LONGEST = 300.0  # [s] for a run, beside the time for which a node is held


def run(folder: Path, config: Path, role: str, held: float) -> tuple[int, float]:
    """Do a run in which a node is held; exit code and seconds."""
    began = time.monotonic()
    deadline = ['--peer-deadline', f'{max(PEER_DEADLINE, 2 * held):g}']
    with folder.with_suffix('.log').open('w') as log:
        command = subprocess.Popen(
            [CODETR, 'train', '--config', config, '--out', folder, '--no-film', *deadline],
            stdout=log, stderr=subprocess.STDOUT,
        )  # fmt: skip
        while command.poll() is None and phase_of(folder) < 3:
            time.sleep(0.02)
        if command.poll() is None:
            there = nodes(folder)[role]
            os.kill(there, signal.SIGSTOP)
            time.sleep(held)
            os.kill(there, signal.SIGCONT)
        while command.poll() is None and time.monotonic() - began < LONGEST + held:
            time.sleep(0.1)
        if command.poll() is None:
            command.send_signal(signal.SIGINT)
        return command.wait(), time.monotonic() - began


def logged(folder: Path, role: str) -> str:
    """A line in which another node states how long it has waited for this one, the last."""
    lines = []
    for path in sorted((folder / 'logs').glob('*.log')):
        if path.stem != role:
            lines += re.findall(rf'({role} /\S+ has been silent for \d+ s; .*)', path.read_text())
    return re.sub(r'/run_\w+', '', lines[-1]) if lines else ''


def main() -> None:
    """Make all rows that are lacking."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--seconds', type=float, default=25.0, help='for which each is held')
    parser.add_argument('--roles', nargs='+', default=list(SETTINGS.roles), help='which are held')
    given = parser.parse_args()
    rows = Rows(OUT, COLUMNS, 2)
    undisturbed = in_process.run(SETTINGS, 'run')
    digests = (
        undisturbed['learner'].policy_sha256,
        undisturbed['reward'].reward_model_sha256,
    )
    for role in given.roles:
        if (role, given.seconds) in rows:
            continue
        with tempfile.TemporaryDirectory(prefix='codetr-stalls-') as place:
            config, folder = Path(place) / 'config.yaml', Path(place) / 'run'
            config.write_text(yaml.safe_dump(SETTINGS.model_dump(mode='json')))
            code, seconds = run(folder, config, role, given.seconds)
            summary = folder / 'summary.json'
            made = json.loads(summary.read_text()) if summary.is_file() else {}
            same = (made.get('policy_sha256'), made.get('reward_model_sha256')) == digests
            sound = verify(folder / 'bag').sound
            said = logged(folder, role)
            if code:
                sys.stderr.write(folder.with_suffix('.log').read_text()[-3000:])
        rows.append(
            (role, given.seconds, code, f'{seconds:.0f}', same, sound, made.get('lost'), said)
        )


if __name__ == '__main__':
    main()
