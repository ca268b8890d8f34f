"""The set-up: what it takes for done, what it does again, what it changes in the wheels."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import bootstrap
from bootstrap import Setup, mend_cmake_files
from bootstrap_checks import SetupError
from helpers.set_up import EVERYTHING, Recorded

ROOT = Path(__file__).resolve().parents[2]


def stages(root: Path) -> list[str]:
    setup = Recorded(root)
    setup.run()
    return setup.stages


def test_a_new_folder_is_set_up_whole_and_then_not_touched_again(root: Path):
    assert stages(root) == EVERYTHING
    assert stages(root) == []


def test_a_changed_requirement_reinstalls_and_rebuilds_in_the_same_environment(root: Path):
    stages(root)
    (root / 'requirements-ros.txt').write_text('numpy==2.2.5\n')
    assert stages(root) == EVERYTHING[1:]


def test_a_changed_message_rebuilds_the_workspace_only(root: Path):
    stages(root)
    (root / 'msgs' / 'msg' / 'Step.msg').write_text('uint64 step\n')
    assert stages(root) == ['workspace', 'check']
    assert stages(root) == []


def test_a_new_launch_file_is_linked_but_an_edited_one_needs_nothing(root: Path):
    stages(root)
    launch = root / 'codetr_ros' / 'launch' / 'train.launch.py'
    launch.parent.mkdir(parents=True)
    launch.write_text('')
    assert stages(root) == ['workspace', 'check']
    launch.write_text('edited = True\n')
    assert stages(root) == []


def test_an_interrupted_installation_is_begun_again_from_nothing(root: Path):
    interrupted = Recorded(root, fail='packages', code=-9)
    with pytest.raises(SetupError):
        interrupted.run()
    assert (interrupted.site / 'half').exists()
    assert stages(root) == EVERYTHING
    assert not (interrupted.site / 'half').exists()


def test_an_environment_whose_making_was_interrupted_is_made_anew(root: Path):
    setup = Recorded(root)
    setup.make_environment()
    (setup.python.parent / 'pip').unlink()
    assert stages(root) == EVERYTHING


def test_an_interrupted_removal_of_an_environment_is_completed(root: Path):
    (root / '.venv-removed').mkdir()
    (root / '.venv-removed' / 'half').touch()
    assert stages(root) == EVERYTHING
    assert not (root / '.venv-removed').exists()


def test_an_installation_that_failed_by_itself_is_taken_up_where_it_was(root: Path):
    with pytest.raises(SetupError, match='it broke'):
        Recorded(root, fail='packages,packages by pip', code=1).run()
    assert stages(root) == EVERYTHING[1:]


def test_an_interrupted_build_does_not_install_packages_again(root: Path):
    with pytest.raises(SetupError, match='does not build.*setup-workspace.log'):
        Recorded(root, fail='workspace').run()
    assert stages(root) == ['workspace', 'check']


@pytest.mark.parametrize(
    ('field', 'value'), [('python', [3, 9]), ('path', '/elsewhere/.venv'), ('headers', '/old')]
)
def test_an_environment_of_another_python_or_place_is_made_anew(
    root: Path, field: str, value: object
):
    stages(root)
    file = root / '.venv' / 'setup.json'
    state = json.loads(file.read_text())
    state['identity'][field] = value
    file.write_text(json.dumps(state))
    assert stages(root) == EVERYTHING


def test_an_environment_that_somebody_made_here_is_kept_and_completed(root: Path):
    Recorded(root).make_environment()
    assert stages(root) == EVERYTHING[1:]


def test_an_environment_that_was_moved_here_is_made_anew(root: Path):
    setup = Recorded(root)
    setup.make_environment()
    (setup.python.parent / 'pip').write_text('#!/elsewhere/.venv/bin/python\n')
    assert stages(root) == EVERYTHING


def test_a_folder_of_somebody_else_in_the_place_of_the_environment_is_not_removed(root: Path):
    (root / '.venv').mkdir()
    (root / '.venv' / 'thesis.tex').touch()
    with pytest.raises(SetupError, match='is no virtual environment. Move it out of the way'):
        Recorded(root).run()
    assert (root / '.venv' / 'thesis.tex').exists()


def test_commands_run_without_the_variables_of_another_ros(
    root: Path, monkeypatch: pytest.MonkeyPatch
):
    setup = Setup(root)
    setup.venv.mkdir()
    monkeypatch.setenv('PYTHONPATH', '/opt/ros/jazzy')
    monkeypatch.setenv('LD_LIBRARY_PATH', '/opt/ros/jazzy/lib')
    show = (
        'import os; names = ("PYTHONPATH", "LD_LIBRARY_PATH", "AMENT_PREFIX_PATH");'
        'print([os.environ.get(name) for name in names])'
    )
    code, output = setup.call('check', [sys._base_executable, '-S', '-c', show])
    assert (code, output.strip()) == (0, str([None, None, str(setup.venv)]))
    assert output in setup.log('check').read_text()


def test_the_directories_of_the_wheels_builder_are_replaced_once_and_for_all(tmp_path: Path):
    file = tmp_path / 'a' / 'cmake' / 'x.cmake'
    file.parent.mkdir(parents=True)
    file.write_text(
        'include "/opt/python/cp311-cp311/include/python3.11;'
        '/opt/python/cp311-cp311/lib/python3.11/site-packages/numpy/_core/include" kept\n'
    )
    site = Path('/v/lib/python3.11/site-packages')
    assert mend_cmake_files(tmp_path, '/usr/include/python3.11', site) == 1
    assert (
        file.read_text() == 'include "/usr/include/python3.11;'
        '/v/lib/python3.11/site-packages/numpy/_core/include" kept\n'
    )
    assert mend_cmake_files(tmp_path, '/usr/include/python3.11', site) == 0


def test_mending_an_environment_leaves_the_files_of_the_cache_as_they_are(tmp_path: Path):
    cached = tmp_path / 'cache' / 'x.cmake'
    cached.parent.mkdir()
    cached.write_text('include "/opt/python/cp311-cp311/include/python3.11"\n')
    linked = tmp_path / 'share' / 'x.cmake'
    linked.parent.mkdir()
    os.link(cached, linked)  # as uv does
    assert mend_cmake_files(linked.parent, '/usr/include/python3.11', Path('/v')) == 1
    assert linked.read_text() == 'include "/usr/include/python3.11"\n'
    assert cached.read_text() == 'include "/opt/python/cp311-cp311/include/python3.11"\n'
    assert [path.name for path in linked.parent.iterdir()] == ['x.cmake']


def test_a_second_set_up_waits_for_the_first_and_says_so(root: Path):
    waiting = 'import bootstrap, sys\nwith bootstrap.alone(sys.argv[1]): print("in", flush=True)'
    with bootstrap.alone(root):
        process = subprocess.Popen(
            [sys._base_executable, '-c', waiting, str(root)],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert 'waiting for it' in process.stdout.readline()
    assert process.communicate(timeout=120)[0] == 'in\n'


def test_make_names_an_interpreter_that_does_not_exist():
    done = subprocess.run(
        ['make', 'setup', 'PYTHON=python3.99'],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode != 0
    assert "there is no command 'python3.99'" in done.stderr
    assert 'apt install python3 python3-venv' in done.stderr
