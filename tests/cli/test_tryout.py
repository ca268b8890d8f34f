"""What a run needs is tried out before anything of it is made."""

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import gymnasium
import pytest
import torch

from codetr_ros import cli
from codetr_ros.cli import tryout
from codetr_ros.cli.tryout import TryoutError
from codetr_ros.config import load
from codetr_ros.processes import launcher
from helpers.executables import prefix
from helpers.own_environments import Point, registered

MODULE = """
import os, sys, threading, time
import gymnasium, numpy as np
from helpers.own_environments import Point

class Leaves(Point):
    def __init__(self): os.abort()
class Hangs(Point):
    def close(self): threading.Event().wait()
class Threaded(Point):
    def __init__(self): super().__init__(); print('hello, I am the arm')
class Old(Point):
    def step(self, action): return super().step(action)[:4]
class Large(Point):
    observation_space = gymnasium.spaces.Box(-1, 1, (30_000,))
    def observe(self): return np.zeros(30_000, np.float32)

for kind in (Leaves, Hangs, Threaded, Old, Large):
    gymnasium.register(f'{kind.__name__}-v0', kind, max_episode_steps=50)
gymnasium.register('Horizonless-v0', Point)
"""
MADE = [f'{n}-v0' for n in ('Leaves', 'Hangs', 'Threaded', 'Old', 'Large', 'Horizonless')]


@pytest.fixture(autouse=True)
def _surroundings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A folder with a module of tasks and executables that would be started, and no run."""
    before = dict(os.environ)
    (tmp_path / 'own_tasks.py').write_text(MODULE)
    (tmp_path / 'work').mkdir()
    monkeypatch.chdir(tmp_path / 'work')
    helpers = str(Path(__file__).parents[1])
    paths = [str(tmp_path), helpers, os.environ.get('PYTHONPATH', '')]
    monkeypatch.setenv('PYTHONPATH', os.pathsep.join(filter(None, paths)))
    monkeypatch.setattr(sys, 'path', [*sys.path, str(tmp_path)])
    yield
    sys.modules.pop('own_tasks', None)
    for name in [name for name in gymnasium.registry if name in MADE]:
        del gymnasium.registry[name]
    for name in os.environ.keys() - before.keys():
        del os.environ[name]
    os.environ.update(before)


@pytest.fixture
def built(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Executables of nodes, which leave a file behind when they are started."""
    started = f'#!/bin/sh\ntouch {tmp_path}/started\n'
    venv = prefix(tmp_path / 'venv')
    monkeypatch.setattr(sys, 'prefix', str(venv))
    for path in venv.rglob('lib/*/*'):
        if path.is_file():
            path.write_text(started)


WAYS = pytest.mark.parametrize(
    'way',
    [pytest.param((), id='over topics', marks=pytest.mark.slow), ('--in-process',)],
)
REFUSED = [
    ('CartPole-v1', (), 'its action space is Discrete(2)'),
    ('own_tasks:Old-v0', (), "task 'own_tasks:Old-v0', step 1 of the episode: it returned 4 val"),
    ('own_tasks:Large-v0', (), 'takes more than the 200000 bytes of a message'),
    ('own_tasks:Horizonless-v0', (), 'has no horizon'),
    ('own_tasks:Missing-v0', (), "no task 'own_tasks:Missing-v0' in what module 'own_tasks'"),
    ('no_such_module:Env-v0', (), "module 'no_such_module' cannot be imported"),
    ('own_tasks:Threaded-v0', ('--delay', '51'), 'delay = 51'),
]


@pytest.mark.usefixtures('built')
@WAYS
@pytest.mark.parametrize(('task', 'flags', 'message'), REFUSED)
def test_a_task_that_no_run_can_have_is_refused_before_a_node_starts(
    task: str,
    flags: tuple[str, ...],
    message: str,
    way: tuple[str, ...],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert cli.main(['train', '--task', task, '--delay', '5', *flags, *way]) == 2

    shown = capsys.readouterr().err
    assert message in shown
    assert 'Traceback' not in shown
    assert list(Path.cwd().iterdir()) == []
    assert not (tmp_path / 'started').exists()


@pytest.mark.skipif(torch.cuda.is_available(), reason='needs a machine without a GPU')
@pytest.mark.parametrize('flags', [('--device', 'cuda'), ('--reward-device', 'cuda:3')])
@pytest.mark.usefixtures('built')
@WAYS
def test_a_gpu_that_is_not_there_is_refused_before_a_node_starts(
    flags: tuple[str, str],
    way: tuple[str, ...],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert cli.main(['train', *flags, *way]) == 2

    field = flags[0].strip('-').replace('-', '_')
    assert f'{field}={flags[1]}: torch {torch.__version__}' in capsys.readouterr().err
    assert list(Path.cwd().iterdir()) == []
    assert not (tmp_path / 'started').exists()


@pytest.mark.slow
def test_a_benchmark_of_a_task_that_no_run_can_have_is_refused_before_its_folder_is_made(
    capsys: pytest.CaptureFixture[str],
) -> None:
    lists = 'methods: [none]\ncomposites: [sum]\ndelays: [5]\nseeds: [0, 1]\nsteps: 300\n'
    spec = Path('../spec.yaml')
    spec.write_text(f'tasks: [Ant-v4, CartPole-v1]\n{lists}')

    assert cli.main(['benchmark', 'run', str(spec), '--out', 'made']) == 2

    assert 'its action space is Discrete(2)' in capsys.readouterr().err
    assert list(Path.cwd().iterdir()) == []


@pytest.mark.slow
@pytest.mark.usefixtures('built')
def test_a_task_that_only_this_process_knows_is_refused_over_topics(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with registered(Point) as name:
        tryout.here(load('quick').changed({'task': name}))
        assert cli.main(['train', '--task', name]) == 2

    assert '`module:id` imports the module that registers it' in capsys.readouterr().err
    assert list(Path.cwd().iterdir()) == []


@pytest.mark.skipif(torch.cuda.is_available(), reason='needs a machine without a GPU')
def test_a_gpu_that_a_method_has_no_use_for_is_not_asked_for() -> None:
    changes = {'reward_device': 'cuda', 'method': 'uniform'}
    tryout.here(load('quick').changed(changes))
    with pytest.raises(TryoutError, match='reward_device=cuda: torch'):
        tryout.here(load('quick').changed(changes | {'method': 'rrd'}))


@pytest.mark.usefixtures('built')
@WAYS
def test_a_compiler_that_is_not_there_is_refused_before_a_folder_is_made(
    way: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv('CXX', '/nowhere/g++')

    assert cli.main(['train', '--config', 'cpu', *way]) == 2

    shown = capsys.readouterr().err
    assert "there is no C++ compiler '/nowhere/g++'" in shown
    assert 'or set sac.compile=false' in shown
    assert list(Path.cwd().iterdir()) == []


@pytest.mark.usefixtures('built')
def test_ros_that_is_not_there_is_refused_before_a_folder_is_made(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, 'codetr_ros.ros.watch', None)

    assert cli.main(['train']) == 2

    assert 'ROS cannot be imported' in capsys.readouterr().err
    assert list(Path.cwd().iterdir()) == []


def apart(task: str) -> None:
    settings = load('quick').changed({'task': task, 'delay': 5})
    tryout.tasks.find(task)
    tryout.apart(settings, launcher.environment(settings))


@pytest.mark.slow
def test_an_environment_that_prints_is_no_refusal(capfd: pytest.CaptureFixture[str]) -> None:
    apart('own_tasks:Threaded-v0')
    assert capfd.readouterr().out == ''


@pytest.mark.slow
def test_an_environment_that_ends_its_process_is_refused() -> None:
    with pytest.raises(TryoutError, match=r"'own_tasks:Leaves-v0' ended the process.* -6: mend"):
        apart('own_tasks:Leaves-v0')


@pytest.mark.slow
def test_an_environment_that_hangs_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tryout, 'DEADLINE', 3.0)
    with pytest.raises(TryoutError, match=r"'own_tasks:Hangs-v0' was not made, .* within 3 s"):
        apart('own_tasks:Hangs-v0')


def test_a_named_task_whose_library_is_not_installed_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(tryout.importlib.util, 'find_spec', lambda name: None)
    for task, library in (('cheetah-run', 'dm_control'), ('Ant-v4', 'gymnasium')):
        settings = load('quick').changed({'task': task})
        for tried in (tryout.here, lambda s: tryout.apart(s, {})):
            with pytest.raises(TryoutError, match=f"'{task}' needs {library} and mujoco: install"):
                tried(settings)
