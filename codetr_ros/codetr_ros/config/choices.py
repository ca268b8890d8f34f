"""What may be chosen: composite rewards and methods, and what sets some methods apart."""

from typing import Annotated, Literal

from pydantic import Field

from codetr_ros.config.base import in_words

Scorers = tuple[
    Annotated[
        str,
        Field(
            pattern=in_words(
                r'^[A-Za-z0-9_-]{1,64}$', '1 to 64 letters, digits, underscores and hyphens'
            )
        ),
    ],
    ...,
]
"""Names of scorers that are no simulators."""

Joiners = tuple[
    Annotated[
        str,
        Field(
            pattern=in_words(
                r'^[A-Za-z][A-Za-z0-9_]{0,63}$',
                'the name of a node: 1 to 64 letters, digits and underscores, a letter first',
            )
        ),
    ],
    ...,
]
"""Names of simulators that may join a running run."""

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
