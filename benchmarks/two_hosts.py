"""Does a run on two hosts, over a bad network, end as if nothing had happened?

    .venv/bin/python benchmarks/two_hosts.py [--runs N] [--cut S]

The simulator runs on one host, all other nodes on another. The hosts are namespaces of this
machine: each has a network, process ids and a `/dev/shm` of its own. The cable between them loses,
doubles, delays and reorders frames, as the seed draws it, and is cut with a phase under way, for
30 seconds by default: longer than the middleware keeps silent peers, 20 s. Small runs in lock-step
and with overlap. The digests of policy and reward model are compared with those of the same run in
process. A row for each run; one that is in the file is not made again.
"""

import argparse
import random
import sys
import tempfile
import time
from pathlib import Path

from rows import Rows

sys.path.insert(0, str(Path(__file__).parent.parent / 'tests'))
from codetr_ros.cores import in_process
from codetr_ros.nodes.signing import new_key
from helpers import hosts
from helpers.builders import tiny
from helpers.hosts import Hosts, Weather
from helpers.nodes import RUN_ID, Nodes, domain

OUT = Path(__file__).parent / 'results' / 'two_hosts.csv'
COLUMNS = (
    'method', 'overlap', 'seed', 'lost', 'doubled', 'delay_ms', 'cut_s', 'cut_after_phase',
    'frames', 'frames_lost', 'seconds', 'exit_codes', 'same',
)  # fmt: skip
KINDS = [(method, overlap) for method in ('codetr', 'rrd', 'none') for overlap in (False, True)]
STEPS = 1600
CUT_SECONDS = 30.0
LONGEST = 400.0  # [s] for a run, beside the cut


def weather(rng: random.Random) -> Weather:
    """What the cable does in a run."""
    return Weather(
        rng.choice((0.0, 0.02, 0.1)), rng.choice((0.0, 0.1)), rng.choice((0, 0.01, 0.05))
    )


def run(folder: Path, method: str, overlap: bool, seed: int, cut: float) -> list[object]:
    """Do a run; what the row has of it."""
    rng = random.Random(seed)
    settings = tiny(method=method, overlap=overlap, steps=STEPS, evaluate_every=0)
    expected = in_process.run(settings, RUN_ID)
    cable, phase, began = weather(rng), rng.randrange(1, 5), time.monotonic()
    shown = cable.lost, cable.doubled, f'{1000 * cable.delay:g}', cut, phase
    with (
        domain(),
        Hosts(cable, seed) as both,
        Nodes(settings, folder, both.starter({'sim': 0}), new_key()) as nodes,
    ):
        for name in nodes.names:
            nodes.start(name)
        both.cut_amid_a_phase(nodes, phase, cut)
        while None in nodes.codes().values() and time.monotonic() - began < LONGEST + cut:
            time.sleep(0.5)
        codes = nodes.codes()
        frames = both.carried, both.lost
    same = set(codes.values()) == {0}
    if same:
        same = nodes.report('learner')['policy_sha256'] == expected['learner'].policy_sha256
        if reward := expected.get('reward'):
            ours = nodes.report('reward')['reward_model_sha256']
            same = same and ours == reward.reward_model_sha256
    if not same:
        print(*(nodes.log(name)[-4000:] for name in nodes.names), sep='\n', file=sys.stderr)
    words = ' '.join(f'{name}={code}' for name, code in codes.items() if code != 0) or 'all 0'
    return [*shown, *frames, f'{time.monotonic() - began:.0f}', words, same]


def main() -> int:
    """Make all rows that are lacking; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--runs', type=int, default=6, help='runs, all kinds in turn')
    parser.add_argument('--first', type=int, default=0, help='number of the first run')
    parser.add_argument('--cut', type=float, default=CUT_SECONDS, help='seconds of the cut')
    given = parser.parse_args()
    if why := hosts.why_not():
        print(f'two hosts cannot be made here: {why}', file=sys.stderr)
        return 2
    rows = Rows(OUT, COLUMNS, 3)
    for number in range(given.first, given.runs):
        kind = method, overlap = KINDS[number % len(KINDS)]
        if (*kind, number) in rows:
            continue
        with tempfile.TemporaryDirectory(prefix='codetr-hosts-') as place:
            rows.append(
                [*kind, number, *run(Path(place) / 'run', method, overlap, number, given.cut)]
            )
    return 0


if __name__ == '__main__':
    sys.exit(main())
