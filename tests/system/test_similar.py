"""Names that are close to one that does not exist."""

import pytest

from codetr_ros.config import Settings, names
from codetr_ros.system.similar import did_you_mean


@pytest.mark.parametrize(
    ('given', 'known', 'meant'),
    [
        ('trian', ['train', 'fit'], ' (did you mean train?)'),
        ('dealy', list(names(Settings)), ' (did you mean delay?)'),
        ('warmup-step', list(names(Settings)), ' (did you mean warmup_steps?)'),
        ('layer', list(names(Settings)), ' (did you mean codetr.layers or rbt.layers?)'),
        ('zzz', ['train', 'fit'], ''),
    ],
)
def test_the_name_that_was_meant_is_found(given: str, known: list[str], meant: str) -> None:
    said = did_you_mean(given, known)
    assert said.startswith(meant.partition(' or ')[0]) if meant else said == ''
