"""Does a run with a key that is lied to all the time end as if nobody had been there?

    .venv/bin/python benchmarks/lies.py [--runs N]

Small runs over topics, in lock-step and with overlap, by three methods. A visitor without the key
reads everything and publishes, from before the first node starts until the last has ended:
commits, labels, steps, scores, policies, tasks, runs, presences, results and metrics that are
well-formed and false, not signed or signed with another key, some under the instance id of a true
node; what it has heard, as it came, with a later stamp, with a bit changed or on another topic;
junk; steps of a megabyte of a source that does not exist. It also offers the services of all
nodes. In every second run a node is killed and started again, which then asks those services. A
seed draws all of it.

A row for each run: how many lies were told, the smallest share of them that a node refused on a
topic that it reads (less than 1: some were told before the middleware had found the node, or
overran its queue), the most that a node grew by after the first tenth of the run, whether the bag
is sound, and whether policy and reward model have the digests of the same run in process. A row
that is in the file is not made again.
"""

import argparse
import os
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
from rows import Rows

os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
sys.path.insert(0, str(Path(__file__).parent.parent / 'tests'))
from codetr_ros.bags.verify import verify
from codetr_ros.cores import in_process
from codetr_ros.nodes.signing import new_key
from codetr_ros.records import TOPICS, Presence
from codetr_ros.records.roles import read_by
from helpers import forked
from helpers.builders import tiny, transitions
from helpers.lies import FIRST, LIES, Liar
from helpers.nodes import RUN_ID, Nodes, domain

OUT = Path(__file__).parent / 'results' / 'lies.csv'
COLUMNS = (
    'method', 'overlap', 'seed', 'lies', 'answers', 'kills', 'least_refused', 'grown_mb',
    'seconds', 'exit_codes', 'sound', 'same',
)  # fmt: skip
KINDS = [(method, overlap) for method in ('codetr', 'rrd', 'none') for overlap in (False, True)]
STEPS, PHASES = 3000, 15
PACE = 150.0  # lies a second: on no topic more than its queue holds while a node works
LARGE = 0.02  # share of steps of a megabyte
LONGEST = 400.0  # [s] for a run


class Visit:
    """A run, and who lies to it.

    Args:
        nodes: those of the run.
        liar: who lies.
        rng: draws when and how.
    """

    def __init__(self, nodes: Nodes, liar: Liar, rng: random.Random) -> None:
        self._nodes = nodes
        self._liar = liar
        self._rng = rng
        self.kills = 0
        self.sizes: list[dict[str, int]] = []
        self._due = [(rng.randrange(2, PHASES - 2), rng.choice(('sim', 'reward', 'learner')))]
        self._killed: set[str] = set()

    def go_on(self, seconds: float) -> None:
        """Lie for a while, and listen."""
        end = time.monotonic() + seconds
        for _ in range(round(PACE * seconds)):
            if self._rng.random() < LARGE:
                self._liar.tell_record(large())
            else:
                self._liar.tell_something(*LIES)
        self._liar.listen(end - time.monotonic())

    def kill(self) -> None:
        """Kill a node when it is time, and start it again."""
        phase = self._liar.commits[-1].phase if self._liar.commits else -1
        if self._due and phase >= self._due[0][0]:
            _, name = self._due.pop()
            if name in self._nodes.names and self._nodes.codes()[name] is None:
                self._nodes.send(signal.SIGKILL, name)
                self._nodes.wait(name)
                self._nodes.start(name)
                self._killed.add(name)
                self.kills += 1

    def least_refused(self, before: Counter[str]) -> float:
        """The smallest share of the lies that a node refused on a topic."""
        shares = [1.0]
        for name in self._nodes.names:
            refused = self._nodes.report(name)['refused']
            for kind in (Presence, *read_by(self._nodes.role(name))):
                topic = TOPICS[kind]
                told = self._liar.told[topic] - before[topic]
                if told > 0 and kind in LIES and name not in self._killed:
                    shares.append(refused.get(topic, 0) / told)
        return min(shares)

    def grown(self) -> float:
        """The most megabytes that a node has grown by since the first tenth of the run."""
        first = len(self.sizes) // 10
        return max(
            (size - before[name]) / 1e6
            for before, last in ((self.sizes[first], self.sizes[-1]),)
            for name, size in last.items()
            if name in before and name not in self._killed
        )


def large() -> object:
    """Steps of a megabyte, of nobody."""
    rows = np.zeros((125_000, 2), np.float32)
    return transitions(source='stranger', steps=124_999, observations=rows, actions=rows[:-1])


def run(folder: Path, method: str, overlap: bool, seed: int) -> list[object]:
    """Do a run; what the row has of it."""
    settings = tiny(method=method, overlap=overlap, steps=STEPS, evaluate_every=STEPS // 2)
    expected = in_process.run(settings, RUN_ID)
    began = time.monotonic()
    with domain(), Nodes(settings, folder, key=new_key()) as nodes, Liar(nodes, seed) as liar:
        visit = Visit(nodes, liar, random.Random(seed))
        for kind in FIRST:
            liar.tell_record(LIES[kind](liar, liar.rng))
        liar.start_services('fetch_phase', *(f'{name}/fetch_phase' for name in nodes.names))
        nodes.start_before(liar)
        before = Counter(liar.told)
        while None in (codes := nodes.codes()).values() and time.monotonic() - began < LONGEST:
            visit.go_on(0.2)
            if seed % 2:
                visit.kill()
            if len(sizes := nodes.memory()) == len(nodes.names):
                visit.sizes.append(sizes)
        words = ' '.join(f'{name}={code}' for name, code in codes.items() if code != 0)
        same = not words
        if same:
            same = nodes.report('learner')['policy_sha256'] == expected['learner'].policy_sha256
            if reward := expected.get('reward'):
                ours = nodes.report('reward')['reward_model_sha256']
                same = same and ours == reward.reward_model_sha256
        else:
            print(*(nodes.log(name)[-3000:] for name in nodes.names), sep='\n', file=sys.stderr)
        told, asked = liar.told.total(), liar.asked
        least = f'{visit.least_refused(before):.3f}' if same else ''
    seconds, grown = f'{time.monotonic() - began:.0f}', f'{visit.grown():.1f}'
    sound = verify(folder / 'bag').sound
    return [told, asked, visit.kills, least, grown, seconds, words or 'all 0', sound, same]


def main() -> None:
    """Make all rows that are lacking."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--runs', type=int, default=6, help='runs, all kinds in turn')
    given = parser.parse_args()
    rows = Rows(OUT, COLUMNS, 3)
    try:
        for number in range(given.runs):
            kind = method, overlap = KINDS[number % len(KINDS)]
            if (*kind, number) in rows:
                continue
            with tempfile.TemporaryDirectory(prefix='codetr-lies-') as place:
                rows.append([*kind, number, *run(Path(place) / 'run', method, overlap, number)])
    finally:
        forked.end_server()


if __name__ == '__main__':
    main()
