"""What judgements of people are worth: return against the number of judgements, beside the oracle.

Simulated people (docs/people.md) score segments of three tasks on scales of their own: they answer
late, leave out one segment in five, and err in one judgement of ten. The same runs with the true
step rewards show what could be reached. A run takes some minutes in process; the table goes on
where it ended.

    python benchmarks/people.py [--only TASK ...] [--seeds 2] [--budgets 60 30 120 15]

Columns of results/people.csv: the task, judgements that people may give in the run (`oracle`: true
rewards), points of their scale, segments asked for
in each phase, share of preferences, people, seed, judgements that were given,
mean true return of the last evaluation and of the random policy, the wall time, and the commit of
the program. Rows of older commits stay as long as the program does the same runs. The goal is
90 % of the way from the random policy to the oracle with 60 judgements.
"""

import argparse
import math
import time
from pathlib import Path
from typing import Any

import torch
from rows import Rows

import machine
from codetr_ros.config import Settings, load
from codetr_ros.cores import in_process
from codetr_ros.records import CompositeReward, EpisodeResult, Preference, Record

RESULTS = Path(__file__).parent / 'results' / 'people.csv'
COLUMNS = (
    *('task', 'budget', 'points', 'requests', 'preferences', 'people', 'seed'),
    *('given', 'final', 'random', 'wall_s', 'commit'),
)
TASKS: dict[str, dict[str, Any]] = {
    'Reacher-v5': {'delay': 50, 'steps': 20_000, 'people.best': -3.0},
    'InvertedPendulum-v5': {'delay': 20, 'steps': 12_000},
    'Pusher-v5': {'delay': 100, 'steps': 30_000, 'people.best': -20.0},
}
"""Settings of each that differ from `COMMON`."""
COMMON: dict[str, Any] = {
    'method': 'evidence',
    'evidence.link': 'known',
    'warmup_steps': 2000,
    'evaluate_episodes': 10,
    'people.late': 300,
    'people.skipped': 0.2,
    'people.wrong': 0.1,
    'threads': 1,
}


def settings_of(
    task: str,
    budget: str,
    points: int,
    requests: int,
    preferences: float,
    people: int,
    seed: int,
) -> Settings:
    """The settings of one run."""
    changes = {'task': task, 'seed': seed, **COMMON, **TASKS[task]}
    changes['evaluate_every'] = changes['steps'] // 4
    if budget == 'oracle':
        changes |= {'method': 'true'}
    else:
        changes |= {
            'scorer': 'simulated',
            'people.judgements': int(budget),
            'requests': requests,
            'people.points': points,
            'people.preferences': preferences,
            'people.count': people,
        }
    return load('quick').changed(changes)


def asked(budget: int, steps: int) -> int:
    """Segments to ask for in each phase, so that the judgements last for the whole run."""
    answered = (1 - COMMON['people.skipped']) * steps / 1000
    return max(1, math.ceil(budget / answered))


def done(
    task: str,
    budget: str,
    points: int,
    requests: int,
    preferences: float,
    people: int,
    seed: int,
) -> list[object]:
    """Do a run; the rest of its row."""
    given = 0
    final: dict[int, list[float]] = {}
    random: list[float] = []

    def observe(record: Record) -> None:
        nonlocal given
        if isinstance(record, EpisodeResult) and record.purpose == 'evaluation':
            final.setdefault(record.step, []).append(record.true_return)
        elif isinstance(record, EpisodeResult) and record.purpose == 'random':
            random.append(record.true_return)
        elif isinstance(record, (CompositeReward, Preference)) and record.scorer != 'sim':
            given += 1

    began = time.monotonic()
    settings = settings_of(task, budget, points, requests, preferences, people, seed)
    in_process.run(settings, 'people', None, observe)
    last = final[max(final)]
    means = [sum(values) / len(values) for values in (last, random)]
    wall = time.monotonic() - began
    return [given, *(f'{mean:.2f}' for mean in means), f'{wall:.0f}']


def main() -> None:
    """Do what is not in the table yet."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--only', nargs='*', default=list(TASKS))
    parser.add_argument('--budgets', nargs='*', default=['60', '30', '120', '15'])
    parser.add_argument('--seeds', type=int, default=2)
    parser.add_argument('--preferences', type=float, default=0.0)
    parser.add_argument('--people', type=int, default=1)
    parser.add_argument('--points', type=int, default=5)
    parser.add_argument('--requests', type=int, default=0, help='0: even over the run')
    given = parser.parse_args()
    torch.set_num_threads(1)
    commit = machine.commit()
    table = Rows(RESULTS, COLUMNS, keys=7)
    for seed in range(given.seeds):
        for budget in ('oracle', *given.budgets):
            for task in given.only:
                how: tuple[float, ...] = (0, 0, 0.0, 0)
                if budget != 'oracle':
                    evenly = asked(int(budget), TASKS[task]['steps'])
                    requests = given.requests or evenly
                    how = (given.points, requests, given.preferences, given.people)
                key = (task, budget, *how, seed)
                if key not in table:
                    table.append([*key, *done(task, budget, *how, seed), commit])


if __name__ == '__main__':
    main()
