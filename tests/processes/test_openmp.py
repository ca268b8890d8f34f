"""How threads wait, and whether there is room for them."""

import os
import subprocess
import sys

import pytest

from codetr_ros.processes.openmp import SPINS, crowded, waiting_environment
from codetr_ros.system import processors


def test_the_library_that_torch_brings_heeds_both_variables() -> None:
    """It lists what it has read; another runtime, without GNU's variable, would not."""
    shown = subprocess.run(
        [sys.executable, '-c', 'import torch'],
        env=os.environ | waiting_environment() | {'OMP_DISPLAY_ENV': 'verbose'},
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    ).stderr
    assert f"GOMP_SPINCOUNT = '{SPINS}'" in shown
    assert "OMP_WAIT_POLICY = 'PASSIVE'" in shown


def test_a_number_of_spins_that_the_user_has_set_stays() -> None:
    assert waiting_environment({'GOMP_SPINCOUNT': '7'})['GOMP_SPINCOUNT'] == '7'


@pytest.mark.parametrize(
    ('threads', 'load', 'busy'),
    [(1, 9.0, False), (2, 0.0, False), (2, 0.9, False), (2, 1.0, True), (3, 0.0, True)],
)
def test_threads_without_a_core_each_are_called_slow(
    monkeypatch: pytest.MonkeyPatch, threads: int, load: float, busy: bool
) -> None:
    monkeypatch.setattr(processors, 'count', lambda: 2)

    reason = crowded(threads, load)

    assert (reason is not None) == busy
    if reason:
        assert f'{threads} threads in each process' in reason
        assert '--threads 1' in reason
