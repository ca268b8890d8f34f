"""How much memory does a process take that holds a million steps of Ant?

    .venv/bin/python benchmarks/memory.py

Each measurement is a process of its own that fills the memory D with steps of Ant (27 or 105
observations, 8 actions, delay 25) and does the work of its role with it:
  - learner: every step is labelled, then SAC updates of the preset `paper` draw from it
  - reward: every segment is scored, then CoDeTr of the preset `paper` takes the moments of all
    observations, two gradient steps, and labels 2560 segments

Episodes have 1000 steps or, every second one, 50 to 450. `peak` is the largest resident set of
the process (`ru_maxrss`), and `bare` its size before the first step: Python, numpy and torch.
`own` is the size of the stored numbers: observation, action, label, its version and two flags of
each step. Goal: peak within 1.5 GiB.
"""

import argparse
import csv
import json
import resource
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import machine

RESULTS = Path(__file__).parent / 'results' / 'memory'
ACTION, DELAY = 8, 25
MIB = 2**20
LIMIT = 1536


def peak() -> float:
    """The largest resident set of this process so far, in MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def episodes(steps: int, rng: np.random.Generator) -> Iterator[tuple[int, int]]:
    """Number and length of episodes that make up this many steps."""
    number = 0
    while steps:
        length = min(steps, 1000 if number % 2 else int(rng.integers(50, 450)))
        yield number, length
        number, steps = number + 1, steps - length


def work(role: str, observation: int, steps: int) -> dict[str, Any]:
    """Fill a memory and use it; returns the memory that this process took."""
    import torch

    from codetr_ros.config import load
    from codetr_ros.learners.flat_sac import FlatSAC
    from codetr_ros.memory.trajectories import Trajectories
    from codetr_ros.records import CompositeReward, StepRewards, Transitions
    from codetr_ros.rewards.codetr import Codetr

    torch.set_num_threads(1)
    settings = load('paper').changed({'sac.compile': False})
    memory = Trajectories(observation, ACTION, DELAY, steps, 2000)
    rng = np.random.default_rng(0)
    bare = peak()
    for number, length in episodes(steps, rng):
        seen = rng.standard_normal((length + 1, observation), np.float32)
        actions = rng.uniform(-1, 1, (length, ACTION)).astype(np.float32)
        memory.append(
            Transitions(
                run_id='run',
                source='sim',
                sequence=number,
                phase=0,
                episode=number,
                first_step=0,
                steps=length,
                observations=seen,
                actions=actions,
                terminated=length < 1000,
                truncated=length == 1000,
                phase_end=False,
                scores_due=0,
            )
        )
        firsts = np.arange(0, length, DELAY)
        lengths = np.minimum(DELAY, length - firsts)
        if role == 'reward':
            for first, size in zip(firsts.tolist(), lengths.tolist(), strict=True):
                memory.score(
                    CompositeReward(
                        run_id='run',
                        source='sim',
                        scorer='sim',
                        sequence=0,
                        episode=number,
                        first_step=first,
                        length=size,
                        value=1.0,
                    )
                )
        else:
            labels = np.zeros(length, np.float32)
            memory.apply(
                StepRewards(
                    run_id='run',
                    phase=0,
                    version=1,
                    part=0,
                    parts=1,
                    source='sim',
                    episodes=np.full(len(firsts), number, np.uint32),
                    first_steps=firsts.astype(np.uint32),
                    lengths=lengths.astype(np.uint32),
                    labels=labels,
                )
            )
    filled = peak()
    if role == 'reward':
        model = Codetr(settings, observation, ACTION)
        model.prepare(memory)
        for _ in range(2):
            model.gradient_step(memory, rng)
        ids = memory.segments.ids()
        for first in range(0, 2560, model.label_batch):
            for _ in model.label_passes(memory, ids[first : first + model.label_batch]):
                pass
    else:
        sac = FlatSAC(observation, ACTION, settings.sac, 0)
        sac.burst(settings.sac.burst, lambda rows: memory.labelled.sample(rng, rows))
    return {
        'bare_mib': round(bare),
        'own_mib': round(memory.bytes_per_step * steps / MIB),
        'filled_mib': round(filled),
        'peak_mib': round(peak()),
        'stored_by_own': round(memory.nbytes / (memory.bytes_per_step * steps), 3),
        'filled_by_own': round((filled - bare) * MIB / (memory.bytes_per_step * steps), 3),
    }


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--steps', type=int, default=1_000_000)
    parser.add_argument('--out', type=Path, default=RESULTS, help='without its suffix')
    parser.add_argument('--work', nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.work:
        role, observation = arguments.work
        print(json.dumps(work(role, int(observation), arguments.steps)))
        return
    before = machine.load()
    rows = []
    for observation in (27, 105):
        for role in ('learner', 'reward'):
            asked = ['--work', role, str(observation), '--steps', str(arguments.steps)]
            done = subprocess.run(
                [sys.executable, __file__, *asked], check=True, capture_output=True, text=True
            )
            sizes = json.loads(done.stdout)
            rows.append(
                {'role': role, 'observations': observation, 'steps': arguments.steps} | sizes
            )
            print(rows[-1], flush=True)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    with arguments.out.with_suffix('.csv').open('w', newline='') as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    names = [name.replace('_mib', ' [MiB]').replace('_by_', ' / ') for name in rows[0]]
    text = ['# What a process takes that holds steps of Ant', '']
    text += [f'- {name}: {value}' for name, value in machine.facts(before, ('torch',)).items()]
    worst = max(row['peak_mib'] for row in rows)
    text += ['', f'The largest peak is {worst} MiB; goal: {LIMIT} MiB.']
    text += ['What is measured: `benchmarks/memory.py`.', '']
    text += [f'| {" | ".join(names)} |', '|---' * len(names) + '|']
    text += [f'| {" | ".join(str(value) for value in row.values())} |' for row in rows]
    arguments.out.with_suffix('.md').write_text('\n'.join(text) + '\n')


if __name__ == '__main__':
    main()
