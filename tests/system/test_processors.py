import os
from pathlib import Path

import pytest

from codetr_ros.system import processors

UNLIMITED = len(os.sched_getaffinity(0))


@pytest.mark.parametrize(
    ('files', 'granted'),
    [
        ({}, None),
        ({'cpu.max': 'max 100000\n'}, None),
        ({'cpu.max': '150000 100000\n'}, 1.5),
        ({'cpu.max': '50000 100000\n'}, 0.5),
        ({'cpu.max': 'what 100000\n'}, None),
        ({'cpu.max': ''}, None),
        ({'cpu/cpu.cfs_quota_us': '-1\n', 'cpu/cpu.cfs_period_us': '100000\n'}, None),
        ({'cpu/cpu.cfs_quota_us': '300000\n', 'cpu/cpu.cfs_period_us': '100000\n'}, 3.0),
        ({'cpu/cpu.cfs_quota_us': '300000\n'}, None),
    ],
)
def test_a_container_grants_as_much_time_as_its_control_group_names(
    tmp_path: Path, files: dict[str, str], granted: float | None
) -> None:
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)

    assert processors.quota(tmp_path) == granted


@pytest.mark.parametrize(
    ('granted', 'count'), [(None, UNLIMITED), (0.5, 1), (1.5, 1), (1000.0, UNLIMITED)]
)
def test_what_is_granted_counts_in_whole_processors(
    monkeypatch: pytest.MonkeyPatch, granted: float | None, count: int
) -> None:
    monkeypatch.setattr(processors, 'quota', lambda: granted)

    assert processors.count() == count
