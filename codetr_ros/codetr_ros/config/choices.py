"""What may be chosen: composite rewards and methods, and what sets some methods apart."""

from typing import Literal

Composite = Literal[
    'sum',
    'sum_square',
    'square_sum',
    'max',
    'max_hard',
    'max_log_sum_exp',
    'max_times_n',
    'minimum',
    'peak_end',
]

Method = Literal[
    'codetr',
    'none',
    'rbt',
    'rrd',
    'ircr',
    'diaster',
    'lrr',
    'mil_lstm',
    'hc',
    'lirpg',
    'mlp',
    'aggregate',
    'evidence',
    'uniform',
    'random',
    'true',
    'ones',
]

Scorer = Literal['simulator', 'person', 'topic', 'simulated']

IN_PROCESS_ONLY = {
    'true': 'is a reference that looks at true rewards, which no node may see',
    'ones': 'is a reference that ignores the scores',
    'lirpg': 'learns on-policy, each phase from its own steps alone',
}
"""Methods that run in process only, and the reason."""

SCORE_LEARNERS: tuple[str, ...] = ('hc', 'lirpg')
"""Methods whose policy learner learns from the composite rewards themselves, without a reward node
that labels steps."""
