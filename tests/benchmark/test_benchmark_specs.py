"""The specs that the repository ships can be run as they are."""

from pathlib import Path
from typing import get_args

import pytest

from codetr_ros import config
from codetr_ros.benchmark import spec

SPECS = Path(__file__).resolve().parents[2] / 'benchmarks' / 'specs'
REFERENCES = {'ones'}
"""A control that is no method of the paper's kind: in the default task's table only."""


@pytest.mark.parametrize('path', sorted(SPECS.glob('*.yaml')), ids=lambda path: path.stem)
def test_a_shipped_spec_is_valid(path: Path) -> None:
    cells = spec.load(path).cells

    assert len(cells) == len({cell.name for cell in cells})
    assert {0, 1, 2} <= {cell.settings.seed for cell in cells}, 'three seeds at least'


def test_the_papers_spec_has_its_delays_composite_rewards_and_settings() -> None:
    made = spec.load(SPECS / 'paper.yaml')

    assert made.keys['delays'] == [5, 25, 50, 100, 200, 500]
    assert made.keys['composites'] == ['sum', 'sum_square', 'square_sum', 'max']
    methods = set(get_args(config.Settings.model_fields['method'].annotation))
    assert set(made.keys['methods']) == methods - REFERENCES
    assert made.base == config.load('paper').changed({'delay': 5})
