"""Modules that users name: how they are found, and how other processes find the same ones."""

import subprocess
import sys
from pathlib import Path

import pytest

from codetr_ros.system import modules


@pytest.fixture
def module(tmp_path, monkeypatch):
    """A package with a module in a folder of its own; gives the module's name."""
    package = tmp_path / 'own_robot_tasks'
    package.mkdir()
    (package / '__init__.py').touch()
    (package / 'arm.py').write_text('MADE = True\n')
    monkeypatch.setattr(sys, 'path', [entry for entry in sys.path if entry])
    yield 'own_robot_tasks.arm'
    for name in ('own_robot_tasks.arm', 'own_robot_tasks'):
        sys.modules.pop(name, None)


@pytest.mark.parametrize(
    ('task', 'name'),
    [
        ('Ant-v4', None),
        ('robots/Arm-v0', None),
        ('arm:Arm-v0', 'arm'),
        ('own.arm:robots/Arm-v0', 'own.arm'),
        (':Arm-v0', ''),
    ],
)
def test_a_task_names_the_module_before_its_colon(task, name):
    assert modules.of_task(task) == name


def test_a_module_in_the_current_folder_is_found(module, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    loaded = modules.load(module)
    assert loaded.MADE
    assert modules.file_of_task(f'{module}:X-v0') == str(tmp_path / 'own_robot_tasks/arm.py')


def test_what_a_module_lacks_is_named_and_not_looked_for(module, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'own_robot_tasks' / 'arm.py').write_text('import no_such_driver\n')
    with pytest.raises(ModuleNotFoundError, match='no_such_driver'):
        modules.load(module)


def test_another_process_finds_the_module_that_this_one_imported(module, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, 'path', [*sys.path, str(tmp_path)])
    modules.load(module)
    path = modules.search_path(module, '/somewhere')
    assert path == f'/somewhere:{tmp_path}'
    assert modules.search_path(module, path) == path
    program = 'from own_robot_tasks import arm; print(arm.__file__)'
    done = subprocess.run(
        [sys.executable, '-c', program],
        env={'PYTHONPATH': path},
        cwd='/',
        capture_output=True,
        text=True,
        check=True,
    )
    assert Path(done.stdout.strip()) == tmp_path / 'own_robot_tasks/arm.py'


@pytest.mark.parametrize('module', ['numpy.linalg', 'json', 'sys', 'never_imported'])
def test_what_every_interpreter_finds_needs_no_path(module):
    assert modules.search_path(module, '/before') == '/before'


def test_the_version_of_a_tasks_package_is_that_of_its_distribution():
    assert modules.version_of_task('Ant-v4') == {}
    assert modules.version_of_task('gymnasium.envs:Ant-v4')['gymnasium'][0].isdigit()
    assert modules.version_of_task('own_robot:Arm-v0') == {'own_robot': None}
    assert modules.file_of_task('own_robot:Arm-v0') is None
