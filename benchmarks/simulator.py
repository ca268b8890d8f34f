"""How near is a simulated step to the cost of its physics, and how much does acting cost?

    .venv/bin/python benchmarks/simulator.py                    # on an idle machine

Everything runs on one thread, in rounds that go through all candidates, in another order each
time. A ratio is of two measurements of one round; the tables give the median of the rounds, and
the lowest and highest in brackets.

Steps, for each Gymnasium MuJoCo task that has a name here, under the same random actions from the
same starts (the script checks that all end in the same states; resets are not timed):
  - ours: `EpisodeRunner.step` of simulators and the evaluator: the scaled action, the physics,
    observation, reward, termination, finite numbers, segments and scores
  - floor: the physics and the observation alone, `mj_step` with the task's frame skip and the
    environment's own `_get_obs`. Humanoid's observation has contact forces, so its floor includes
    `mj_rnePostConstraint`
  - gymnasium: `step` of the environment of `gymnasium.make`

Actions, of a policy of 256x256 with noise, one observation at a time, for the sizes of the same
tasks:
  - ours: `ActingPolicy.act`
  - module: the network's forward pass and the same arithmetic, in plain PyTorch
  - numpy: the same with numpy's products

`--clock cpu` counts CPU time instead of wall time: for a machine that does other things as well.
"""

import argparse
import csv
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import torch

import machine
from codetr_ros.config import Settings
from codetr_ros.policy.acting import ActingPolicy, uniform_actions
from codetr_ros.policy.actor import Actor, linear_layers
from codetr_ros.records import F32
from codetr_ros.seeding import generator
from codetr_ros.simulation import tasks
from codetr_ros.simulation.episode import EpisodeRunner

RESULTS = Path(__file__).parent / 'results'
PACKAGES = ('mujoco', 'gymnasium', 'numpy', 'torch')
CLOCKS = {'wall': time.perf_counter, 'cpu': time.process_time}
COLUMNS = ('what', 'task', 'name', 'round', 'calls', 'seconds')
NAMES = [name for name, task in tasks.TASKS.items() if task.library == 'gymnasium']
HIDDEN = (256, 256)
CALLS = 2000
"""Actions of a policy in a round."""


@dataclass(frozen=True)
class Player:
    """Something that steps a task.

    Attributes:
        reset: begins an episode from a seed.
        prepare: turns actions in [-1, 1] into the arguments of `play`.
        play: takes the actions; this is timed.
        observation: returns the last one.
    """

    reset: Callable[[int], Any]
    prepare: Callable[[F32], list[Any]]
    play: Callable[[list[Any]], None]
    observation: Callable[[], Any]


def ours(name: str) -> Player:
    """This project's own steps."""
    environment = tasks.make(name)
    episode = EpisodeRunner(environment, Settings(task=name), 'sim')

    def play(actions: list[F32]) -> None:
        step = episode.step
        for action in actions:
            step(action)

    return Player(lambda seed: episode.reset(seed, 0), list, play, lambda: episode.observation)


def floor(name: str) -> Player:
    """Physics and observation alone."""
    env: Any = gymnasium.make(name, disable_env_checker=True).unwrapped
    model, data, frames, ctrl = env.model, env.data, env.frame_skip, env.data.ctrl
    observe = env._get_obs  # noqa: SLF001
    forces = name.startswith('Humanoid')

    def play(actions: list[F32]) -> None:
        for action in actions:
            ctrl[:] = action
            mujoco.mj_step(model, data, nstep=frames)
            if forces:
                mujoco.mj_rnePostConstraint(model, data)
            observe()

    return Player(
        lambda seed: env.reset(seed=seed), lambda a: scaled(env.action_space, a), play, observe
    )


def plain(name: str) -> Player:
    """Gymnasium in its usual form."""
    env: Any = gymnasium.make(name)

    def play(actions: list[F32]) -> None:
        step = env.step
        for action in actions:
            step(action)

    return Player(
        lambda seed: env.reset(seed=seed),
        lambda a: scaled(env.action_space, a),
        play,
        env.unwrapped._get_obs,  # noqa: SLF001
    )


def scaled(box: Any, actions: F32) -> list[F32]:
    """Actions in [-1, 1], scaled to the bounds of an environment."""
    return list((box.high + box.low) / 2 + (box.high - box.low) / 2 * actions)


def episodes(name: str, steps: int) -> Iterator[tuple[int, F32]]:
    """Seeds and actions of episodes under the random policy, with this many steps together."""
    environment = tasks.make(name)
    episode = EpisodeRunner(environment, Settings(task=name), 'sim')
    seed = 0
    while steps > 0:
        episode.reset(seed, 0)
        most = min(steps, environment.horizon)
        actions = uniform_actions(generator(0, name, seed), most, environment.action_size)
        while episode.length < most and not episode.over:
            episode.step(actions[episode.length])
        yield seed, actions[: episode.length]
        steps -= episode.length
        seed += 1


def step_rows(name: str, arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """All rounds of one task."""
    clock = CLOCKS[arguments.clock]
    players = {'ours': ours(name), 'floor': floor(name), 'gymnasium': plain(name)}
    trace = list(episodes(name, arguments.steps))
    prepared = {who: [p.prepare(a) for _, a in trace] for who, p in players.items()}
    rows = []
    for number in range(-1, arguments.rounds):  # round -1 is not counted
        seconds = {}
        for who in turned(list(players), number):
            player, spent = players[who], 0.0
            for (seed, _), actions in zip(trace, prepared[who], strict=True):
                player.reset(seed)
                began = clock()
                player.play(actions)
                spent += clock() - began
            seconds[who] = spent
        ends = {
            who: np.asarray(player.observation(), np.float32) for who, player in players.items()
        }
        if any((end != ends['ours']).any() for end in ends.values()):
            raise SystemExit(f'{name}: the candidates do not end in the same state: {ends}')
        rows += rows_of('step', name, number, arguments.steps, seconds)
    return rows


def actors(observation_size: int, action_size: int) -> dict[str, Callable[[F32, F32], Any]]:
    """Ways of acting, all with the same weights."""
    torch.manual_seed(0)
    actor = Actor(observation_size, action_size, HIDDEN)
    weights = [
        (layer.weight.detach().numpy().copy(), layer.bias.detach().numpy().copy())
        for layer in linear_layers(actor)
    ]

    def module(observation: F32, noise: F32) -> F32:
        with torch.no_grad():
            mean, log_std = actor(torch.from_numpy(observation))
            action: F32 = torch.tanh(mean + log_std.exp() * torch.from_numpy(noise)).numpy()
        return action

    def numpy(observation: F32, noise: F32) -> F32:
        x = observation
        for weight, bias in weights[:-1]:
            x = np.maximum(weight @ x + bias, 0)
        weight, bias = weights[-1]
        mean, log_std = np.split(weight @ x + bias, 2)
        return np.tanh(mean + np.exp(np.clip(log_std, -10, 2)) * noise)

    return {'ours': ActingPolicy(actor).act, 'module': module, 'numpy': numpy}


def action_rows(name: str, arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """All rounds of a policy for one task."""
    clock = CLOCKS[arguments.clock]
    environment = tasks.make(name)
    sizes = environment.observation_size, environment.action_size
    rng = generator(0, 'actions', name)
    observations, noise = (
        list(rng.standard_normal((CALLS, size), dtype=np.float32)) for size in sizes
    )
    ways = actors(*sizes)
    rows = []
    for number in range(-1, arguments.rounds):
        seconds = {}
        for who in turned(list(ways), number):
            act = ways[who]
            began = clock()
            for o, e in zip(observations, noise, strict=True):
                act(o, e)
            seconds[who] = clock() - began
        rows += rows_of('action', name, number, CALLS, seconds)
    return rows


def turned(names: list[str], number: int) -> list[str]:
    """The names, with another one first in each round."""
    at = number % len(names)
    return names[at:] + names[:at]


def rows_of(
    what: str, task: str, number: int, calls: int, seconds: dict[str, float]
) -> list[dict[str, Any]]:
    """The rows of a round; none for the round that is not counted."""
    if number < 0:
        return []
    return [
        dict(zip(COLUMNS, (what, task, who, number, calls, f'{s:.6f}'), strict=True))
        for who, s in seconds.items()
    ]


# ----------------------------------------------------------------------------------------------
# the tables

TABLES = {
    'step': ('Steps', ('ours', 'floor', 'gymnasium'), ('floor', 'gymnasium')),
    'action': ('Actions, one observation at a time', ('ours', 'module', 'numpy'), ('module',)),
}
"""For each kind of row: its title, the candidates shown, and those that ours are compared with."""


def tables(rows: list[dict[str, Any]]) -> list[str]:
    """The tables in Markdown, line by line."""
    lines = []
    for what, (title, names, others) in TABLES.items():
        some = [row for row in rows if row['what'] == what]
        if not some:
            continue
        head = ['task', *(f'{who} [us]' for who in names), *(f'ours / {who}' for who in others)]
        lines += [
            f'## {title}',
            '',
            f'| {" | ".join(head)} |',
            '|---|' + '---:|' * (len(head) - 1),
        ]
        for task in dict.fromkeys(row['task'] for row in some):
            took = {
                who: [
                    1e6 * float(row['seconds']) / int(row['calls'])
                    for row in some
                    if (row['task'], row['name']) == (task, who)
                ]
                for who in names
            }
            cells = [machine.spread(took[who], '.1f') for who in names]
            for who in others:
                pairs = zip(took['ours'], took[who], strict=True)
                cells.append(machine.spread([a / b for a, b in pairs], '.2f'))
            lines.append(f'| {task} | {" | ".join(cells)} |')
        lines.append('')
    return lines


def write(out: Path, rows: list[dict[str, Any]], text: str) -> None:
    """`simulator.csv`, a row for each measurement, and `simulator.md`."""
    out.mkdir(parents=True, exist_ok=True)
    with (out / 'simulator.csv').open('w', newline='') as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator='\n')
        writer.writeheader()
        writer.writerows(rows)
    (out / 'simulator.md').write_text(text)


def main() -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--rounds', type=int, default=9)
    parser.add_argument('--steps', type=int, default=2000, help='of a task in a round')
    parser.add_argument('--only', default='', help='tasks whose name contains this')
    parser.add_argument('--clock', choices=list(CLOCKS), default='wall')
    parser.add_argument('--out', type=Path, default=RESULTS)
    arguments = parser.parse_args()
    load_at_start = machine.load()
    torch.set_num_threads(1)
    rows = []
    for name in NAMES:
        if arguments.only in name:
            print(name, file=sys.stderr, flush=True)
            rows += step_rows(name, arguments) + action_rows(name, arguments)
    facts = {
        **machine.facts(load_at_start, PACKAGES),
        'rounds': f'{arguments.rounds}, of {arguments.steps} steps and {CALLS} actions',
        'clock': arguments.clock,
    }
    circumstances = [f'- {name}: {fact}' for name, fact in facts.items()]
    text = '\n'.join(['# The simulator', '', *tables(rows), *circumstances]) + '\n'
    print(text, end='')
    write(arguments.out, rows, text)
    return 0


if __name__ == '__main__':
    sys.exit(main())
