"""Why does method `evidence` take squares of Hopper for sums? For want of a feature of falls.

    .venv/bin/python benchmarks/naming_ends.py --out benchmarks/results/naming_ends.csv

The trials of `naming.py` that it named wrongly although it was sure. Each is fitted again, by two
kinds of score: with the features of the method, and with one more, which is 1 in the last step of
a segment that was cut short (there an episode ended) and 0 elsewhere.

    evidence           log evidence of the scores: the larger one is named
    left_out_rms       of levels that are predicted from all other scores, in units of their scale
"""

import argparse
from dataclasses import replace
from pathlib import Path

import naming
import numpy as np
import torch
from rows import Rows

import machine
import reward_recovery
from codetr_ros.rewards.evidence.features import Features
from codetr_ros.rewards.evidence.link import Sum, SumSquare
from codetr_ros.rewards.evidence.model import Model
from codetr_ros.rewards.evidence.sample import Sample, Sampler

TRIALS = (52, 85, 88, 101, 149)
COLUMNS = ('trial', 'scores', 'features', 'kind', 'evidence', 'left_out_rms', 'commit')
MOST = 300
"""Scores from which the scales are learnt, as the method has it."""


def with_ends(sample: Sample) -> Sample:
    """The sample with a further feature, of the ends of segments that were cut short."""
    ends = np.cumsum(sample.m) - 1
    flags = torch.zeros(len(sample.rows), 1)
    flags[torch.tensor(ends[sample.m < sample.m.max()])] = 1
    return replace(sample, rows=torch.cat([sample.rows, flags], 1))


def left_out_rms(model: Model, sample: Sample) -> float:
    """Of the levels of all scores that the scales were learnt from."""
    levels = model.link.level(sample.scores, sample.m) / model.scale
    return float(np.sqrt((1 - model.left_out_r2) * levels.var()))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--out', type=Path, default=Path('benchmarks/results/naming_ends.csv'))
    parser.add_argument('--cache', type=Path, default=Path('.venv/cache'))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    commit = machine.commit()
    steps = reward_recovery.replay(arguments.cache / 'replay_Hopper-v5.npz', 15_000, 'Hopper-v5')
    rows = Rows(arguments.out, COLUMNS, keys=4)
    for number in TRIALS:
        settings, scores = naming.drawn(number, {'Hopper-v5': steps})
        assert (settings.task, settings.composite) == ('Hopper-v5', 'sum_square')
        train, _ = reward_recovery.memories(steps, settings, None, scores)
        ids = train.segments.ids()[:MOST]
        features = Features(train.observation_size, train.action_size, settings.seed)
        sampler = Sampler(features)
        features.renew(sampler.moments(train, ids))
        sampler.forget()
        sample = sampler.sample(train, ids, steps=True)
        end = slice(features.size, features.size + 1)
        several = {
            'those of the method': (sample, features.blocks),
            'and ends': (with_ends(sample), [*features.blocks, end]),
        }
        for name, (seen, blocks) in several.items():
            for link in (Sum(), SumSquare()):
                if (number, len(ids), name, link.name) in rows:
                    continue
                model = Model(link, blocks)
                model.fit(seen, np.arange(len(ids)))
                rms = left_out_rms(model, seen)
                key = (number, len(ids), name, link.name)
                rows.append([*key, f'{model.evidence:.1f}', f'{rms:.5f}', commit])


if __name__ == '__main__':
    main()
