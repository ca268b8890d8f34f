"""How fast are SAC updates, sampling from the memory included, and how fast could they be?

    python3 -m venv /tmp/sbx-venv
    /tmp/sbx-venv/bin/pip install -r benchmarks/requirements-sbx.txt

    .venv/bin/python benchmarks/sac_updates.py --sbx /tmp/sbx-venv/bin/python

Each of them has a process of its own, which does nothing while another works and may use as many
processors as it has threads. Compared are:
  - compiled: the updates of `sac.compile=true`
  - eager: the updates of `sac.compile=false`
  - plain: the same update by autograd, in its simplest form (`learners/sac.py`)
  - sb3, sbx: `train()` of Stable-Baselines3 and of SBX (JAX) with the same settings
  - floor: the floating point operations that an update needs, at the rate that products of
    256x256 matrices reach here. It counts only the products of the algorithm: no gradients of the
    critics' weights in the actor's step, and no unused gradients of inputs.

Every process holds 100 000 random steps of the sizes of Ant (27 or 105 observations, 8 actions) or
HalfCheetah (17, 6), draws its batches from them, and takes `--updates` updates a round. Rounds go
through all of them in turn. A ratio is of two measurements of one round; the table gives the
median round, and the lowest and highest in brackets. The rates leave out compiling, which has its
own columns: `cold` with an empty cache, `warm` with the cache that this left.

`--clock cpu` counts a process's CPU time instead of wall time: for one thread on a machine that
does other things as well.
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
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

import machine

RESULTS = Path(__file__).parent / 'results' / 'sac_updates'
STEPS, EPISODE = 100_000, 1000
BURST = 50
OURS = ('compiled', 'eager', 'plain')
THEIRS = ('sb3', 'sbx')
PACKAGES = ('torch', 'numpy', 'stable-baselines3', 'sbx-rl', 'jax')


@dataclass(frozen=True)
class Size:
    """The task, the size of the networks and the threads."""

    task: str
    observation: int
    action: int
    width: int
    batch: int
    threads: int

    @property
    def flops(self) -> int:
        """Operations of the products of one update: two for each multiplication."""
        O, A, H = self.observation, self.action, self.width  # noqa: E741, N806
        critics = 2 * ((O + A) * H + H * H + H)
        actor = O * H + H * H + H * 2 * A
        back = 2 * H * H  # through the critics' second layers
        forwards = 2 * actor + 3 * critics  # on s' and s; targets, critics, critics again
        critic_step = critics + back
        actor_step = back + 2 * H * A + 2 * H + actor + H * H + H * 2 * A
        return 2 * self.batch * (forwards + critic_step + actor_step)


def sizes() -> Iterator[Size]:
    """All sizes that are measured."""
    for threads in (1, 2):
        for width in (256, 128):
            for task, observation, action in (
                ('Ant', 27, 8),
                ('Ant', 105, 8),
                ('HalfCheetah', 17, 6),
            ):
                yield Size(task, observation, action, width, width, threads)


# ----------------------------------------------------------------------------------------------
# workers: each prints how long it took to get ready, then how long each round took


def ours(form: str, size: Size) -> Callable[[int], None]:
    """Updates of the learner."""
    import torch

    from codetr_ros.config import SacSettings
    from codetr_ros.learners.flat_sac import FlatSAC
    from codetr_ros.learners.sac import SAC
    from codetr_ros.memory.trajectories import Trajectories
    from codetr_ros.records import StepRewards, Transitions

    torch.set_num_threads(size.threads)
    memory = Trajectories(size.observation, size.action, EPISODE, STEPS, EPISODE)
    rng = np.random.default_rng(0)
    for n in range(STEPS // EPISODE):
        observations = rng.standard_normal((EPISODE + 1, size.observation), np.float32)
        actions = rng.uniform(-1, 1, (EPISODE, size.action)).astype(np.float32)
        memory.append(
            Transitions(
                run_id='run',
                source='sim',
                sequence=n,
                phase=n,
                episode=n,
                first_step=0,
                steps=EPISODE,
                observations=observations,
                actions=actions,
                terminated=False,
                truncated=True,
                phase_end=True,
                scores_due=1,
            )
        )
        episode, first, length = (np.array([number], np.uint32) for number in (n, 0, EPISODE))
        labels = rng.standard_normal(EPISODE, np.float32)
        memory.apply(
            StepRewards(
                run_id='run',
                phase=n,
                version=n,
                part=0,
                parts=1,
                source='sim',
                episodes=episode,
                first_steps=first,
                lengths=length,
                labels=labels,
            )
        )
    settings = SacSettings(
        hidden=(size.width, size.width), batch=size.batch, compile=form == 'compiled'
    )
    if form == 'plain':
        plain = SAC(size.observation, size.action, settings, 0)

        def one_by_one(updates: int) -> None:
            for _ in range(updates):
                plain.update(memory.labelled.sample(rng, size.batch))

        return one_by_one
    flat = FlatSAC(size.observation, size.action, settings, 0)

    def bursts(updates: int) -> None:
        for first in range(0, updates, BURST):
            count = min(BURST, updates - first)
            flat.burst(count, lambda rows: memory.labelled.sample(rng, rows))

    return bursts


def theirs(package: str, size: Size) -> Callable[[int], None]:
    """Updates of SB3 or SBX."""
    parallel = str(size.threads > 1).lower()
    flags = f'--xla_cpu_multi_thread_eigen={parallel} intra_op_parallelism_threads={size.threads}'
    os.environ['XLA_FLAGS'] = f'{os.environ.get("XLA_FLAGS", "")} {flags}'.strip()
    os.environ['JAX_PLATFORMS'] = 'cpu'
    import gymnasium
    import torch
    from stable_baselines3.common.logger import configure

    torch.set_num_threads(size.threads)
    if package == 'sbx':
        from sbx import SAC
    else:
        from stable_baselines3 import SAC

    class Still(gymnasium.Env):
        """An environment of the right sizes, which is never stepped."""

        observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size.observation,))
        action_space = gymnasium.spaces.Box(-1, 1, (size.action,))

    model: Any = SAC(
        'MlpPolicy',
        Still(),
        learning_rate=3e-4,
        buffer_size=STEPS,
        batch_size=size.batch,
        tau=0.005,
        gamma=0.99,
        ent_coef='auto_1.0',
        target_entropy=-size.action / 2,
        policy_kwargs={'net_arch': [size.width, size.width]},
        device='cpu',
        seed=0,
    )
    model.set_logger(configure(None, []))
    rng, buffer = np.random.default_rng(0), model.replay_buffer
    for array in (buffer.observations, buffer.next_observations, buffer.rewards):
        array[:] = rng.standard_normal(array.shape, np.float32)
    buffer.actions[:] = rng.uniform(-1, 1, buffer.actions.shape)
    buffer.full = True
    return lambda updates: model.train(updates, size.batch)


def sgemm(size: Size) -> Callable[[int], None]:
    """Products of 256x256 matrices, with as many operations as the updates."""
    import torch

    torch.set_num_threads(size.threads)
    a, b = torch.randn(2, 256, 256)
    out = torch.empty(256, 256)

    def multiply(updates: int) -> None:
        for _ in range(round(updates * size.flops / (2 * 256**3))):
            torch.mm(a, b, out=out)

    return multiply


def work(name: str, size: Size) -> None:
    """Get ready, then do the rounds requested on standard input."""
    # not all packages keep to their number of threads
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: size.threads])
    began = time.perf_counter()
    if name == 'floor':
        run = sgemm(size)
    else:
        run = ours(name, size) if name in OURS else theirs(name, size)
    state: dict[str, Any] = {'ready': time.perf_counter() - began, 'versions': {}}
    for package in PACKAGES:
        try:
            state['versions'][package] = version(package)
        except PackageNotFoundError:
            continue
    print(json.dumps(state), flush=True)
    for line in sys.stdin:
        wall, cpu = time.perf_counter(), time.process_time()
        run(int(line))
        times = {'wall': time.perf_counter() - wall, 'cpu': time.process_time() - cpu}
        print(json.dumps(times), flush=True)


# ----------------------------------------------------------------------------------------------
# the measurement


class Worker:
    """A process that does rounds of updates on request."""

    def __init__(self, name: str, size: Size, python: str, environment: dict[str, str]) -> None:
        command = [python, __file__, '--work', name, '--size', json.dumps(asdict(size))]
        threads = {'OMP_NUM_THREADS': str(size.threads), 'MKL_NUM_THREADS': str(size.threads)}
        self.process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env=os.environ | threads | environment,
        )
        self.ready = self._answer()

    def _answer(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit(f'a worker ended with {self.process.wait()}: {self.process.args}')
        answer: dict[str, Any] = json.loads(line)
        return answer

    def round(self, updates: int) -> dict[str, Any]:
        """Have it take some updates; returns the seconds that they took."""
        assert self.process.stdin is not None
        print(updates, file=self.process.stdin, flush=True)
        return self._answer()

    def end(self) -> None:
        """End it."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait()


def measure(size: Size, arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """All rounds of one size: a row for each implementation and round."""
    updates = arguments.updates * (256 // size.width) ** 2
    rows = []
    with tempfile.TemporaryDirectory() as cache:
        environment = {'TORCHINDUCTOR_CACHE_DIR': cache}
        cold = Worker('compiled', size, sys.executable, environment)
        cold.end()
        workers = {name: Worker(name, size, sys.executable, environment) for name in OURS}
        workers['floor'] = Worker('floor', size, sys.executable, {})
        if arguments.sbx:
            workers |= {name: Worker(name, size, arguments.sbx, {}) for name in THEIRS}
        for worker in workers.values():
            worker.round(updates)  # not counted
        for n in range(arguments.rounds):
            for name, worker in workers.items():
                times = worker.round(updates)
                rows.append(
                    asdict(size)
                    | {'name': name, 'round': n, 'updates': updates, 'flops': size.flops}
                    | {clock: round(seconds, 4) for clock, seconds in times.items()}
                    | {'cold_s': round(cold.ready['ready'], 1) if name == 'compiled' else ''}
                    | {'ready_s': round(worker.ready['ready'], 1)}
                    | {'versions': json.dumps(worker.ready['versions'])}
                )
        for worker in workers.values():
            worker.end()
    print(line_of(size, rows, arguments.clock), flush=True)
    return rows


def line_of(size: Size, rows: list[dict[str, Any]], clock: str) -> str:
    """The table's line for one size."""
    rates = {
        name: [row['updates'] / row[clock] for row in rows if row['name'] == name]
        for name in ('compiled', 'eager', 'plain', 'sb3', 'sbx', 'floor')
    }
    cells = [f'{size.task} {size.observation}', f'{size.width}', f'{size.threads}']
    cells += [f'{statistics.median(r):.0f}' if r else '-' for r in rates.values()]
    for other in ('floor', 'sbx', 'sb3', 'plain', 'eager'):
        ratios = [a / b for a, b in zip(rates['compiled'], rates[other], strict=False)]
        cells.append(machine.spread(ratios, '.2f') if ratios else '-')
    first = next(row for row in rows if row['name'] == 'compiled')
    cells += [f'{first["cold_s"]:.0f}', f'{first["ready_s"]:.0f}']
    return f'| {" | ".join(cells)} |'


HEAD = (
    '| task | width, batch | threads | compiled | eager | plain | SB3 | SBX | floor '
    '| compiled / floor | / SBX | / SB3 | / plain | / eager | cold [s] | warm [s] |\n'
    f'|{"---|" * 16}'
)


def write(rows: list[dict[str, Any]], arguments: argparse.Namespace, load: str) -> None:
    """Write the CSV file of all rounds, and the table."""
    RESULTS.mkdir(parents=True, exist_ok=True)
    with (RESULTS / 'rounds.csv').open('w', newline='') as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    versions: dict[str, str] = {}
    for row in rows:
        versions |= json.loads(row['versions'])
    of: dict[Size, list[dict[str, Any]]] = {}
    names = list(Size.__dataclass_fields__)
    for row in rows:
        of.setdefault(Size(**{name: row[name] for name in names}), []).append(row)
    text = [
        '# SAC updates per second, sampling included',
        '',
        f'{machine.processor()}, {os.cpu_count()} cores; '
        f'{", ".join(f"{n} {v}" for n, v in versions.items())}; commit {machine.commit()}; '
        f'{arguments.rounds} rounds, {arguments.clock} time; load average {load}.',
        'Median round; ratios: median [lowest, highest] of rounds. What is compared: '
        '`benchmarks/sac_updates.py`.',
        '',
        HEAD,
        *(line_of(size, some, arguments.clock) for size, some in of.items()),
    ]
    (RESULTS / 'table.md').write_text('\n'.join(text) + '\n')


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--sbx', default='', help='a Python with SBX and SB3')
    parser.add_argument('--rounds', type=int, default=7)
    parser.add_argument('--updates', type=int, default=200, help='a round of width 256')
    parser.add_argument('--threads', type=int, nargs='+', default=[1, 2])
    parser.add_argument('--only', default='', help='part of "task observations width"')
    parser.add_argument('--clock', choices=['wall', 'cpu'], default='wall')
    parser.add_argument('--work', default='', help=argparse.SUPPRESS)
    parser.add_argument('--size', type=json.loads, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.work:
        work(arguments.work, Size(**arguments.size))
        return
    before = machine.load()
    print(HEAD, flush=True)
    rows = []
    for size in sizes():
        named = f'{size.task} {size.observation} {size.width}'
        if size.threads in arguments.threads and arguments.only in named:
            rows += measure(size, arguments)
    write(rows, arguments, f'{before} before, {os.getloadavg()[0]:.1f} at the end')


if __name__ == '__main__':
    main()
