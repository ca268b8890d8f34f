"""The library as a wheel, in an environment that holds nothing else and no ROS."""

import os
import shutil
import subprocess
import sys
import venv
import zipfile
from collections.abc import Iterator
from email import message_from_bytes
from pathlib import Path
from xml.etree import ElementTree

import pytest

from bootstrap_options import pip_options, uv_configuration
from helpers.bags import a_run, ours

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / 'codetr_ros'
VERSION = ElementTree.parse(PACKAGE / 'package.xml').getroot().findtext('version')
TINY = [
    '--no-film',
    *('--steps=250', '--phase-steps=100', '--warmup-steps=100', '--evaluate-every=100'),
    *('--codetr.layers=1', '--codetr.embedding=8', '--codetr.first-gradient-steps=2'),
    *('--codetr.gradient-steps=1', '--sac.hidden=8', '--sac.batch=8', '--evaluate-episodes=1'),
]

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]


@pytest.fixture(scope='module')
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built of a copy: a build leaves files beside its sources."""
    folder = tmp_path_factory.mktemp('wheel')
    skip = shutil.ignore_patterns('__pycache__', '*.egg-info', 'build')
    shutil.copytree(PACKAGE, folder / 'codetr_ros', ignore=skip)
    pip = [sys.executable, '-m', 'pip', 'wheel', '--no-deps', '--no-build-isolation']
    subprocess.run([*pip, '-w', folder, folder / 'codetr_ros'], check=True)
    (built,) = folder.glob('*.whl')
    return built


@pytest.fixture(scope='module')
def environment(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """An empty environment into which the wheel has been installed with what it asks for.

    The pins hold the versions to those that the set-up has installed: what uv has in its cache
    need not be downloaded again.
    """
    folder = tmp_path_factory.mktemp('environment')
    venv.create(folder, with_pip=False)
    python = folder / 'bin' / 'python'
    arguments = ['install', '--constraint', str(ROOT / 'requirements.txt'), str(wheel)]
    pip = [sys.executable, '-m', 'pip']
    variables = {name: value for name, value in os.environ.items() if name != 'PYTHONPATH'}
    uv = shutil.which('uv', path=str(Path(sys.executable).parent))
    if uv:
        listed = subprocess.check_output([*pip, 'config', 'list'], text=True)
        flags, translated = uv_configuration(pip_options(listed), os.environ)
        command = [uv, 'pip', *arguments, '--python', str(python), *flags]
        subprocess.run(command, check=True, env={**variables, **translated})
    else:
        subprocess.run([*pip, '--python', str(python), *arguments], check=True, env=variables)
    yield folder
    shutil.rmtree(folder)  # 1 GB and more


def run(environment: Path, *command: str) -> subprocess.CompletedProcess[str]:
    """Run a command of the environment, in a folder outside of the project."""
    variables = {
        name: value
        for name, value in os.environ.items()
        if name not in ('PYTHONPATH', 'AMENT_PREFIX_PATH', 'LD_LIBRARY_PATH', 'VIRTUAL_ENV')
    }
    return subprocess.run(
        [environment / 'bin' / command[0], *command[1:]],
        cwd=environment,
        env=variables,
        capture_output=True,
        text=True,
        check=False,
    )


def test_the_wheel_holds_presets_messages_and_the_mark_of_a_typed_package(wheel: Path):
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        (described,) = (name for name in names if name.endswith('.dist-info/METADATA'))
        description = message_from_bytes(archive.read(described))
    source = PACKAGE / 'codetr_ros'
    wanted = {
        str(path.relative_to(PACKAGE))
        for pattern in ('*.py', '*.yaml', 'py.typed')
        for path in source.rglob(pattern)
    }
    static = (path for path in (source / 'pages/static').rglob('*') if path.is_file())
    wanted |= {str(path.relative_to(PACKAGE)) for path in static}
    wanted |= {f'codetr_ros/bags/msg/{path.name}' for path in (ROOT / 'msgs' / 'msg').iterdir()}
    for name in (
        *('py.typed', 'config/presets/quick.yaml', 'bags/msg/Transitions.msg'),
        *('pages/static/page.js', 'pages/static/uplot/LICENSE'),
    ):
        assert f'codetr_ros/{name}' in wanted
    assert wanted <= names
    assert description['Version'] == VERSION
    assert set(description.get_all('Provides-Extra')) == {'ros', 'ray', 'test', 'docs'}


def test_the_environment_knows_nothing_of_ros_and_of_this_project(environment: Path):
    for module in ('rclpy', 'codetr_msgs', 'sim_node', 'pytest'):
        done = run(environment, 'python', '-c', f'import {module}')
        assert f"No module named '{module}'" in done.stderr
    done = run(environment, 'python', '-c', 'import codetr_ros; print(codetr_ros.__file__)')
    assert done.stdout.startswith(str(environment))


def test_the_command_prints_its_version_and_the_tasks(environment: Path):
    assert run(environment, 'codetr', '--version').stdout == f'codetr {VERSION}\n'
    done = run(environment, 'codetr', 'tasks')
    assert (done.returncode, done.stderr) == (0, '')
    assert 'InvertedDoublePendulum-v5' in done.stdout


def test_training_in_process_and_reading_a_bag_need_nothing_else(
    environment: Path, tmp_path: Path
):
    done = run(environment, 'codetr', 'train', '--in-process', '--out', 'run', *TINY)
    assert done.returncode == 0, done.stdout + done.stderr
    for file in ('summary.json', 'metrics.csv', 'report.html', 'config.yaml'):
        assert (environment / 'run' / file).is_file()
    bag = ours(tmp_path / 'bag', a_run())
    done = run(environment, 'codetr', 'bag', 'verify', str(bag))
    assert done.returncode == 0, done.stdout + done.stderr


def test_what_needs_nodes_says_that_ros_is_missing(environment: Path, tmp_path: Path):
    done = run(environment, 'codetr', 'train', *TINY)
    assert done.returncode == 2
    assert 'Nodes need ROS 2' in done.stderr
    assert '--in-process' in done.stderr
    bag = ours(tmp_path / 'bag', a_run())
    done = run(environment, 'codetr', 'bag', 'play', str(bag), '--to', 'reward')
    assert done.returncode == 2
    assert 'playing needs ROS' in done.stderr
    done = run(environment, 'record')
    assert done.returncode == 2
    assert 'needs ROS 2' in done.stderr
    assert 'Traceback' not in done.stderr
