"""How many threads a run gets where it leaves them to the machine."""

import json
import os
import subprocess
import sys
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from codetr_ros import config
from codetr_ros.config import SettingsError
from codetr_ros.config.threads import MOST
from codetr_ros.cores import in_process
from codetr_ros.processes.openmp import threading_environment
from codetr_ros.records import RunSpec
from codetr_ros.system import processors
from helpers.builders import tiny


def chosen(preset: str, cores: int, runs: int = 1, **changes: Any) -> int:
    names = {name.replace('__', '.'): value for name, value in changes.items()}
    return config.load(preset).changed(names).threads_on(cores, runs)


@pytest.mark.parametrize('preset', config.PRESETS)
def test_threads_are_left_to_the_machine_by_default(preset: str) -> None:
    assert config.load(preset).threads == 'auto'


def test_wide_networks_get_the_cores_that_a_stage_has_to_itself() -> None:
    assert chosen('cpu', 2) == chosen('paper', 2) == 2
    assert chosen('cpu', 1) == 1
    assert chosen('cpu', 3) == 3
    assert chosen('cpu', 64) == MOST == 4


def test_stages_and_runs_side_by_side_share_the_cores() -> None:
    assert chosen('cpu', 2, overlap=True) == 1
    assert chosen('cpu', 4, overlap=True) == 2
    assert chosen('cpu', 2, simulators=2) == 1
    assert chosen('cpu', 6, simulators=2, overlap=True) == 2
    assert chosen('cpu', 2, runs=2) == 1
    assert chosen('cpu', 8, runs=2, overlap=True) == 2
    assert chosen('cpu', 2, envs=8) == 2, 'environments of a simulator take turns'


def test_small_products_and_a_gpu_get_one_thread() -> None:
    assert chosen('quick', 2) == 1
    assert chosen('cpu', 2, sac__batch=64) == 1
    assert chosen('cpu', 2, sac__hidden=(64, 64)) == 1
    assert chosen('cpu', 2, sac__hidden=(512, 64, 512)) == 2
    assert chosen('cpu', 2, device='cuda') == 1
    assert chosen('cpu', 2, method='hc') == 1


@given(
    st.integers(1, 256), st.integers(1, 64), st.integers(1, 8), st.booleans(), st.integers(1, 64)
)
def test_a_number_decides_by_itself(
    threads: int, cores: int, runs: int, overlap: bool, simulators: int
) -> None:
    changes = {'threads': threads, 'overlap': overlap, 'simulators': simulators}
    settings = config.load('quick').changed(changes)

    assert settings.threads_on(cores, runs) == settings.thread_count == threads
    assert config.settled(settings) == settings


def test_what_was_decided_is_a_number_in_the_settings() -> None:
    settled = config.settled(config.load('cpu'))

    assert settled.threads == min(processors.count(), MOST)
    assert settled.changed({'threads': 'auto'}) == config.load('cpu')
    assert json.loads(settled.canonical())['threads'] == settled.threads
    read = config.from_canonical(settled.canonical(), 'here')
    assert (read, read.thread_count) == (settled, settled.threads)


@pytest.mark.parametrize('threads', [0, 257, -1, 1.5, True, 'many', '1000', None])
def test_anything_else_is_refused_by_name_and_value(threads: Any) -> None:
    with pytest.raises(SettingsError, match='a number from 1 to 256, or auto'):
        config.parse({'threads': threads}, 'here')


def test_a_number_may_be_text_as_on_the_command_line() -> None:
    assert config.parse({'threads': '2'}, 'here').threads == 2


def test_the_run_in_process_announces_the_number_that_it_computes_with() -> None:
    seen: list[Any] = []
    settings = tiny(steps=200, evaluate_every=0)
    assert settings.threads == 'auto'

    in_process.run(settings, 'run', observe=seen.append)

    (spec,) = [record for record in seen if isinstance(record, RunSpec)]
    assert json.loads(spec.settings)['threads'] == 1
    assert spec.settings_hash == config.settled(settings).hash() != settings.hash()


def test_more_threads_than_the_machine_has_cores_still_run() -> None:
    """In a process of its own: this one keeps its number of threads."""
    threads = processors.count() + 1
    settings = tiny(steps=200, evaluate_every=0, threads=threads)
    program = (
        'import sys, torch\n'
        'from codetr_ros.config import from_canonical\n'
        'from codetr_ros.cores import in_process\n'
        'reports = in_process.run(from_canonical(sys.stdin.read(), "here"), "run")\n'
        'print(torch.get_num_threads(), reports["learner"].finished)\n'
    )
    done = subprocess.run(
        [sys.executable, '-c', program],
        input=settings.canonical(),
        env=os.environ | threading_environment(settings),
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.stdout.split() == [str(threads), 'True'], done.stderr


def test_a_report_calls_no_number_a_difference_where_the_preset_leaves_it_to_the_machine() -> None:
    settings = config.settled(config.load('cpu')).model_dump(mode='json')

    assert config.differences(settings, 'cpu') == []
    assert config.differences(settings | {'seed': 1}, 'cpu') == [('seed', 0, 1)]
