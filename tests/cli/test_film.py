"""The film strip of a run's report."""

import base64
import io
import os
import subprocess
import sys
import time
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
import yaml

from codetr_ros import cli, config
from codetr_ros.cli import film
from codetr_ros.cores import in_process
from codetr_ros.records import EpisodeResult, Record
from codetr_ros.runs import folder as run_folder
from codetr_ros.simulation import tasks

SETTINGS = config.load('quick').changed(
    {
        'task': 'InvertedPendulum-v5',
        'method': 'uniform',
        'steps': 200,
        'phase_steps': 100,
        'warmup_steps': 100,
        'evaluate_every': 100,
        'evaluate_episodes': 1,
        'sac.hidden': (8,),
        'sac.batch': 8,
    }
)
DRAWS = (
    'import sys, pathlib\n'
    "pathlib.Path(sys.argv[1], 'film.png').write_bytes(b'drawn')\n"
    "print('What to know.')"
)


def child(text: str) -> tuple[str, ...]:
    return sys.executable, '-c', text


@pytest.fixture(scope='module')
def a_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[EpisodeResult]]:
    """The folder of a tiny run, and the results of its evaluations."""
    folder = run_folder.create(tmp_path_factory.mktemp('runs') / 'tiny')
    run_folder.write_settings(folder, SETTINGS)
    records: list[Record] = []
    in_process.run(SETTINGS, 'run', folder, records.append)
    results = [r for r in records if isinstance(r, EpisodeResult) and r.purpose != 'training']
    return folder, results


@pytest.fixture(scope='module')
def driver() -> str:
    """A driver that draws on this machine without a display."""
    program = 'import mujoco, os\nmujoco.GLContext(8, 8).make_current()\nos._exit(0)'
    for name in film.DRIVERS:
        given = {**os.environ, 'MUJOCO_GL': name}
        done = subprocess.run(child(program), env=given, capture_output=True, check=False)
        if done.returncode == 0:
            return name
    pytest.skip('neither EGL nor OSMesa draws on this machine')


@pytest.mark.slow
def test_a_film_shows_the_episodes_of_the_runs_own_evaluations(
    a_run: tuple[Path, list[EpisodeResult]], driver: str
) -> None:
    run_dir, results = a_run
    random, last = results[0], results[-1]
    assert (random.purpose, last.step) == ('random', 200)

    note = film.make(run_dir, environment={**os.environ, 'MUJOCO_GL': driver})

    lengths = f'random policy {random.length} steps, after 200 steps {last.length} steps'
    assert f'It lasted: {lengths}. Drawing it took ' in note
    assert note.endswith(' s.'), note
    image = matplotlib.image.imread(io.BytesIO((run_dir / 'film.png').read_bytes()))
    height, width, _ = image.shape
    assert width == 960
    # both rows have frames, which are not of one colour
    for row in (image[: height // 2], image[height // 2 :]):
        assert np.std(row[..., :3], axis=(0, 1)).min() > 0.05


@pytest.mark.slow
def test_frames_show_a_robot_that_moves_and_the_same_one_again(driver: str) -> None:
    program = (
        'import os, sys\nimport numpy as np\n'
        'from codetr_ros.simulation import tasks\nfrom codetr_ros.simulation.drawing import '
        'Drawing\n'
        'for task in sys.argv[1:]:\n'
        '    env = tasks.make(task)\n'
        '    with Drawing(env, 64, 48) as drawing:\n'
        '        env.reset(0)\n'
        '        first = drawing.frame().copy()\n'
        '        for _ in range(15): env.step(np.ones(env.action_size, np.float32))\n'
        '        later = drawing.frame().copy()\n'
        '        env.reset(0)\n'
        '        again = drawing.frame().copy()\n'
        '    assert first.shape == (48, 64, 3), first.shape\n'
        '    assert (first == again).all(), task\n'
        '    assert np.abs(first.astype(int) - later).mean() > 0.2, task\n'
        "print('done', flush=True)\nos._exit(0)\n"
    )
    names = ('InvertedDoublePendulum-v5', 'cartpole-swingup')
    given = {**os.environ, 'MUJOCO_GL': driver}
    done = subprocess.run(
        [*child(program), *names], env=given, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_what_is_not_of_mujoco_has_no_physics(monkeypatch: pytest.MonkeyPatch) -> None:
    assert tasks.make('Pendulum-v1').physics() is None
    model, data = tasks.make('Hopper-v5').physics()
    assert data.qpos.shape == (model.nq,)


def test_a_machine_that_cannot_draw_is_named_with_its_reason(tmp_path: Path) -> None:
    note = film.make(tmp_path, environment={**os.environ, 'MUJOCO_GL': 'disable'})

    assert note.startswith('No frames of the robot: MuJoCo cannot draw here (disable: ')
    assert not (tmp_path / 'film.png').exists()


def test_a_driver_that_crashes_does_no_harm_and_the_next_is_tried(tmp_path: Path) -> None:
    given = {name: v for name, v in os.environ.items() if name != 'MUJOCO_GL'}
    crashes = "import os\nif os.environ['MUJOCO_GL'] == 'egl': os.abort()\n"

    note = film.make(tmp_path, program=child(crashes + DRAWS), environment=given)
    assert note.startswith('What to know. Drawing it took ')
    assert (tmp_path / 'film.png').read_bytes() == b'drawn'

    note = film.make(tmp_path, program=child('import os\nos.abort()'), environment=given)
    assert 'egl: ended by signal 6; osmesa: ended by signal 6' in note


def test_a_driver_that_hangs_is_given_up_at_the_deadline(tmp_path: Path) -> None:
    began = time.monotonic()

    note = film.make(tmp_path, deadline=0.5, program=child('import time\ntime.sleep(60)'))

    assert 'not done within 0.5 s' in note
    assert time.monotonic() - began < 20


def test_a_run_without_a_policy_is_not_drawn_and_the_note_tells_why(
    tmp_path: Path, driver: str
) -> None:
    folder = run_folder.create(tmp_path / 'run')
    run_folder.write_settings(folder, SETTINGS)

    note = film.make(folder, environment={**os.environ, 'MUJOCO_GL': driver})

    assert note.startswith('No frames of the robot: ')
    assert 'holds no checkpoint of the learner' in note


@pytest.mark.slow
def test_train_and_report_put_the_film_into_the_report(
    tmp_path: Path, driver: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in os.environ.items():  # what `codetr train` sets ends with this test
        monkeypatch.setenv(name, value)
    monkeypatch.setenv('MUJOCO_GL', driver)
    file, folder = tmp_path / 'tiny.yaml', tmp_path / 'run'
    file.write_text(yaml.safe_dump(SETTINGS.model_dump(mode='json')))

    assert cli.main(['train', '--in-process', '--config', str(file), '--out', str(folder)]) == 0

    page = (folder / 'report.html').read_text()
    assert 'Drawing it took' in page
    assert base64.b64encode((folder / 'film.png').read_bytes()).decode() in page

    # where nothing can be drawn, the report goes on and keeps the frames that there are
    monkeypatch.setenv('MUJOCO_GL', 'disable')
    assert cli.main(['report', str(folder)]) == 0
    page = (folder / 'report.html').read_text()
    assert 'No new frames of the robot: MuJoCo cannot draw here (disable: ' in page
    assert base64.b64encode((folder / 'film.png').read_bytes()).decode() in page
