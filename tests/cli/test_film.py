"""The film strip of a run's report."""

import base64
import functools
import io
import os
import subprocess
import sys
import time
from pathlib import Path

import imageio_ffmpeg
import matplotlib.image
import numpy as np
import pytest
import yaml

from codetr_ros import cli, config
from codetr_ros.cli import evaluate, film, rendering, video
from codetr_ros.cores import in_process
from codetr_ros.records import Commit, EpisodeResult, Record
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs.middle import Middle
from codetr_ros.simulation import tasks

SETTINGS = config.load('quick').changed(
    {
        'task': 'InvertedPendulum-v5',
        'method': 'uniform',
        'steps': 400,
        'phase_steps': 100,
        'warmup_steps': 100,
        'evaluate_every': 100,
        'evaluate_episodes': 1,
        'sac.hidden': (8,),
        'sac.batch': 8,
    }
)
PATIENCE = 300.0
"""Seconds for a film of two, where a busy machine draws: the frames are tested, not the time."""
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
    middle = Middle(folder, SETTINGS, print)

    def observe(record: Record) -> None:
        records.append(record)
        middle.look(sum(isinstance(each, Commit) for each in records))

    in_process.run(SETTINGS, 'run', folder, observe)
    results = [r for r in records if isinstance(r, EpisodeResult) and r.purpose != 'training']
    return folder, results


@pytest.fixture(scope='module')
def driver() -> str:
    """A driver that draws on this machine without a display."""
    for name in rendering.DRIVERS:
        if rendering.find({**os.environ, 'MUJOCO_GL': name}).driver == name:
            return name
    pytest.skip('neither EGL nor OSMesa draws on this machine')


@pytest.mark.slow
def test_a_film_shows_the_episodes_of_the_runs_own_evaluations(
    a_run: tuple[Path, list[EpisodeResult]], driver: str
) -> None:
    run_dir, results = a_run
    random, last = results[0], results[-1]
    (middle,) = [result for result in results if result.step == 200]
    assert (random.purpose, last.step) == ('random', 400)

    note = film.make(run_dir, PATIENCE, environment={**os.environ, 'MUJOCO_GL': driver})

    lengths = (
        f'random policy {random.length} steps, after 200 steps {middle.length} steps, '
        f'after 400 steps {last.length} steps'
    )
    assert f'It lasted: {lengths}. The video has the first 3 s of each' in note
    assert note.endswith(' s.'), note
    image = matplotlib.image.imread(io.BytesIO((run_dir / 'film.png').read_bytes()))
    height, width, _ = image.shape
    assert width == 960
    frames = imageio_ffmpeg.read_frames(run_dir / 'film.mp4')
    assert next(frames)['size'] == (3 * film.WIDTH, film.HEIGHT)
    longest = max(random.length, middle.length, last.length)
    assert sum(1 for _ in frames) == longest + 1  # 25 steps a second: none is left out
    assert not list(run_dir.glob('.*'))
    # all rows have frames, which are not of one colour
    for row in np.split(image[: height // 3 * 3], 3):
        assert np.std(row[..., :3], axis=(0, 1)).min() > 0.05


def test_the_policy_half_way_is_kept_and_later_ones_do_not_replace_it(
    a_run: tuple[Path, list[EpisodeResult]],
) -> None:
    folder, _ = a_run
    (kept,) = (folder / run_folder.MIDDLE).iterdir()
    assert kept.name == 'learner-000001'
    settings = evaluate.settings_to_read(folder)
    policy = evaluate.newest_policy(folder, settings, folder / run_folder.MIDDLE)
    assert (policy.version, settings.steps_after(policy.version)) == (1, 200)
    assert not list(folder.glob('.*'))


def test_a_run_that_has_learnt_nothing_half_way_keeps_no_policy(tmp_path: Path) -> None:
    (tmp_path / 'checkpoints' / 'learner-000002').mkdir(parents=True)
    short = SETTINGS.changed({'warmup_steps': 300})
    Middle(tmp_path, short, print).look(4)
    assert not (tmp_path / run_folder.MIDDLE).exists()
    Middle(tmp_path, SETTINGS, print).look(4)
    assert (tmp_path / run_folder.MIDDLE / 'learner-000002').is_dir()


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

    note = film.make(folder, PATIENCE, environment={**os.environ, 'MUJOCO_GL': driver})

    assert note.startswith('No frames of the robot: ')
    assert 'holds no checkpoint of the learner' in note


@pytest.mark.slow
def test_train_and_report_put_the_film_into_the_report(
    tmp_path: Path, driver: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in os.environ.items():  # what `codetr train` sets ends with this test
        monkeypatch.setenv(name, value)
    monkeypatch.setenv('MUJOCO_GL', driver)
    monkeypatch.setattr(film, 'make', functools.partial(film.make, deadline=PATIENCE))
    file, folder = tmp_path / 'tiny.yaml', tmp_path / 'run'
    file.write_text(yaml.safe_dump(SETTINGS.model_dump(mode='json')))

    assert cli.main(['train', '--in-process', '--config', str(file), '--out', str(folder)]) == 0

    page = (folder / 'report.html').read_text()
    assert 'Drawing it took' in page
    assert base64.b64encode((folder / 'film.png').read_bytes()).decode() in page
    coded = base64.b64encode((folder / 'film.mp4').read_bytes()).decode()
    assert f'src="data:video/mp4;base64,{coded}"></video>' in page

    # where nothing can be drawn, the report goes on and keeps the frames that there are
    monkeypatch.setenv('MUJOCO_GL', 'disable')
    assert cli.main(['report', str(folder)]) == 0
    page = (folder / 'report.html').read_text()
    assert 'No new frames of the robot: MuJoCo cannot draw here (disable: ' in page
    assert base64.b64encode((folder / 'film.png').read_bytes()).decode() in page


@pytest.mark.slow
def test_a_video_shows_the_episodes_that_are_evaluated_in_their_own_time(
    a_run: tuple[Path, list[EpisodeResult]], driver: str, tmp_path: Path
) -> None:
    import imageio_ffmpeg

    folder, _ = a_run
    settings = evaluate.settings_to_read(folder).changed({'evaluate_episodes': 2, 'seed': 3}, '')
    results = evaluate.evaluate(evaluate.newest_policy(folder, settings), settings)
    file = tmp_path / 'out.mp4'

    text = video.make(folder, file, settings, environment={**os.environ, 'MUJOCO_GL': driver})

    returns = ', '.join(f'{result.true_return:.6g}' for result in results)
    assert '2 episodes after 400 steps, ' in text
    assert text.endswith(f'true returns {returns} (drawn by {driver})')
    frames = imageio_ffmpeg.read_frames(str(file))
    said = next(frames)
    assert said['size'] == (video.WIDTH, video.HEIGHT)
    assert said['fps'] == 25.0, 'a step of this task takes 0.04 s'
    shown = [np.frombuffer(frame, np.uint8) for frame in frames]
    assert len(shown) == sum(result.length for result in results)
    assert all(frame.std() > 5 for frame in shown)
    assert np.abs(shown[0].astype(int) - shown[results[0].length - 1]).mean() > 0.2, 'it moves'
    assert [path.name for path in tmp_path.iterdir()] == ['out.mp4']


@pytest.mark.slow
def test_where_nothing_can_be_drawn_the_evaluation_is_printed_and_the_reason(
    a_run: tuple[Path, list[EpisodeResult]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for name, value in os.environ.items():  # what `codetr evaluate` sets ends with this test
        monkeypatch.setenv(name, value)
    monkeypatch.setenv('MUJOCO_GL', 'disable')
    file = tmp_path / 'out.mp4'
    assert cli.main(['evaluate', str(a_run[0]), '--video', str(file)]) == cli.FAILED
    said = capsys.readouterr()
    assert 'true return' in said.out
    assert f'no video {file}: MuJoCo cannot draw here (disable: ' in said.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ('name', 'words'),
    [
        ('out.avi', 'must end with .mp4'),
        ('nowhere/out.mp4', 'nowhere cannot be written: No such file or directory'),
    ],
)
def test_a_video_that_cannot_be_written_is_refused_before_anything_is_run(
    a_run: tuple[Path, list[EpisodeResult]],
    name: str,
    words: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    file = str(tmp_path / name)
    assert cli.main(['evaluate', str(a_run[0]), '--video', file]) == cli.USAGE
    said = capsys.readouterr()
    assert words in said.err
    assert said.out == ''
