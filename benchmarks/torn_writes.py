"""Cut the files of a small run off at every byte, and go on with the run.

    python benchmarks/torn_writes.py [--every N]      # N = 1: every byte

A machine that loses its power, or a process that is killed, leaves a file cut off anywhere. For
each length of the bag it is cut back to its last commit: what is left must be the beginning of the
whole bag, up to a commit, record by record, or there is no commit at all. From each of the commits
the run is then gone on with, with its checkpoints or without any, and must end with the weights of
the undisturbed run. For each length of a checkpoint's files loading must be refused. Every byte
takes half an hour on one core.
"""

import argparse
import json
import shutil
import tempfile
import time
from collections import Counter
from pathlib import Path

from codetr_ros.bags.cutting import cut
from codetr_ros.bags.errors import BagError
from codetr_ros.bags.reader import Bag
from codetr_ros.config import Settings, load, settled
from codetr_ros.cores import in_process, taking_up
from codetr_ros.records import Commit
from codetr_ros.runs import checkpoints

RESULTS = Path(__file__).parent / 'results' / 'torn_writes.json'


def settings() -> Settings:
    """Those of a run of some seconds, with small networks."""
    return settled(
        load('quick').changed(
            {
                'task': 'InvertedPendulum-v5',
                'method': 'mlp',
                'steps': 160,
                'phase_steps': 20,
                'warmup_steps': 40,
                'delay': 5,
                'evaluate_every': 60,
                'evaluate_episodes': 1,
                'sac.hidden': (4,),
                'sac.batch': 4,
                'mlp.hidden': (4,),
                'mlp.batch': 4,
                'mlp.first_gradient_steps': 2,
                'mlp.gradient_steps': 1,
                'threads': 1,
            }
        )
    )


def messages(bag: Path) -> list[tuple[str, bytes]]:
    """Topic and bytes of each message."""
    return [(raw.channel.topic, bytes(raw.data)) for raw in Bag(bag).raw()]


def commits(bag: Path) -> list[int]:
    """How many messages lie before each commit's end."""
    return [i + 1 for i, (topic, _) in enumerate(messages(bag)) if topic.endswith('/commits')]


def torn_bag(whole: Path, scratch: Path, every: int) -> dict[str, object]:
    """Cut the bag at each length; what came of it."""
    data = (whole / 'bag' / 'bag_0.mcap').read_bytes()
    all_ = messages(whole / 'bag')
    ends = commits(whole / 'bag')
    found: Counter[str] = Counter()
    refused: dict[str, int] = {}
    for length in range(0, len(data), every):
        bag = scratch / 'torn'
        shutil.rmtree(bag, ignore_errors=True)
        bag.mkdir(parents=True)
        (bag / 'bag_0.mcap').write_bytes(data[:length])
        try:
            made = cut(bag)
        except BagError as error:
            refused.setdefault(str(error)[:80], length)
            continue
        phase = -1 if made.commit is None else made.commit.phase
        found[str(phase)] += 1
        if made.commit is not None:
            left = messages(bag)
            assert left == all_[: ends[phase]], f'{length} bytes: not the beginning of the bag'
    return {'bytes': len(data), 'lengths': sum(found.values()), 'last commit': dict(found),
            'refused': refused}  # fmt: skip


def goes_on(whole: Path, scratch: Path, digest: str) -> int:
    """Go on from each commit of the bag, with the checkpoints of then, and without any."""
    done = 0
    data = (whole / 'bag' / 'bag_0.mcap').read_bytes()
    lengths = {}
    for entry in Bag(whole / 'bag').entries({Commit}):
        lengths[entry.record.phase] = entry.place.offset
    for phase in sorted(lengths):
        # up to the end of the commit's chunk: that is where the next one begins
        later = min((o for p, o in lengths.items() if p > phase), default=len(data))
        folder = scratch / f'again_{phase}'
        (folder / 'bag').mkdir(parents=True)
        (folder / 'bag' / 'bag_0.mcap').write_bytes(data[: later + 1])
        if phase % 2:
            shutil.copytree(whole / 'checkpoints', folder / 'checkpoints')
        reports = taking_up.take_up(settings(), 'run', folder)
        assert reports['learner'].policy_sha256 == digest, f'other weights from phase {phase}'
        done += 1
    return done


def torn_checkpoints(whole: Path, scratch: Path, every: int) -> dict[str, int]:
    """Cut each file of a checkpoint at each length: loading must refuse it."""
    refused = {}
    for name in ('learner', 'reward'):
        newest = checkpoints.latest(whole / 'checkpoints', name)
        assert newest is not None
        for file in (checkpoints.TENSORS, checkpoints.DESCRIPTION):
            path = scratch / f'{name}-000000'
            shutil.rmtree(path, ignore_errors=True)
            shutil.copytree(newest, path)
            data = (newest / file).read_bytes()
            count = 0
            for length in range(0, len(data), every):
                (path / file).write_bytes(data[:length])
                try:
                    checkpoints.load(path)
                except checkpoints.CheckpointError:
                    count += 1
                else:
                    # the last byte of the description is a line's end, which means nothing
                    assert data[length:].strip() == b'', f'{name}/{file} at {length} was taken'
            refused[f'{name}/{file}'] = count
    return refused


def main() -> None:
    """Run it all, and write what came of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--every', type=int, default=1, help='look at every Nth length')
    every = parser.parse_args().every
    began = time.monotonic()
    memory = '/dev/shm' if Path('/dev/shm').is_dir() else None  # the disk is waited for otherwise
    with tempfile.TemporaryDirectory(dir=memory) as place:
        scratch = Path(place)
        whole = scratch / 'whole'
        whole.mkdir()
        reports = in_process.run(settings(), 'run', whole, bag=True)
        digest = reports['learner'].policy_sha256
        assert digest is not None
        result = {
            'every': every,
            'bag': torn_bag(whole, scratch, every),
            'gone on with': goes_on(whole, scratch, digest),
            'checkpoints refused': torn_checkpoints(whole, scratch, every),
            'seconds': round(time.monotonic() - began),
        }
    RESULTS.write_text(json.dumps(result, indent=1) + '\n')
    print(json.dumps(result, indent=1))


if __name__ == '__main__':
    main()
