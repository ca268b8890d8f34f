"""`codetr train --resume`: a run that was killed at any moment ends as if nothing had happened."""

import csv
import json
import os
import random
import re
import shutil
from pathlib import Path

import pytest

from codetr_ros.bags.verify import verify
from codetr_ros.cli import train
from codetr_ros.processes import launcher
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs import origin
from codetr_ros.runs.origin import held
from helpers.builders import tiny
from helpers.forked import codetr
from helpers.runs import finish, start, until, write

SETTINGS = tiny(
    steps=1600, sac__updates_per_step=0.2, evaluate_every=400, threads=1, record_relabels='first'
)
ENVIRONMENT = os.environ | {'COLUMNS': '160'}
OF_TIME = {'run_id', 'began', 'command', 'wall_s', 'steps_per_s', 'bag', 'processes', 'spent'}


def done(settings, folder):
    """An undisturbed run in process."""
    return finish(start(write(settings, folder), folder, '--in-process', '--no-film'), folder)[0]


def metrics(folder: Path):
    """The rows of `metrics.csv` without the columns of times."""
    with (folder / 'metrics.csv').open() as file:
        return [
            {name: value for name, value in row.items() if not name.endswith('seconds')}
            for row in csv.DictReader(file)
        ]


def same(folder: Path, other: Path) -> None:
    """Two runs ended with the same weights, metrics and results."""
    mine, theirs = (json.loads((f / 'summary.json').read_text()) for f in (folder, other))
    assert {n: v for n, v in mine.items() if n not in OF_TIME} == {
        n: v for n, v in theirs.items() if n not in OF_TIME
    }
    assert metrics(folder) == metrics(other)
    assert verify(folder / 'bag').sound


def size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.glob('bag/*.mcap'))


def killed(command, folder: Path, bytes_: int) -> None:
    """Kill a run once its bag has grown by so much."""
    before = size(folder)
    until(lambda: size(folder) >= before + bytes_ or not alive(command), command, folder)
    command.kill()
    command.communicate()


def alive(command) -> bool:
    return command.poll() is None


@pytest.mark.slow
@pytest.mark.parametrize(('seed', 'overlap'), [(0, False), (1, True)])
def test_a_run_that_is_killed_again_and_again_ends_as_an_undisturbed_one(seed, overlap, tmp_path):
    settings = SETTINGS.changed({'overlap': overlap, 'method': 'evidence' if seed else 'codetr'})
    whole, folder = tmp_path / 'whole', tmp_path / 'run'
    done(settings, whole)
    draws = random.Random(seed)
    killed(
        start(write(settings, folder), folder, '--in-process', '--no-film'),
        folder,
        draws.randrange(1000, size(whole) // 3),
    )
    for _ in range(2):
        again = codetr('train', '--resume', str(folder), '--no-film', environment=ENVIRONMENT)
        killed(again, folder, draws.randrange(1000, size(whole) // 4))
    finish(codetr('train', '--resume', str(folder), '--no-film', environment=ENVIRONMENT), folder)
    same(folder, whole)
    assert len(origin.read(folder).resumed) == 3


@pytest.fixture(scope='module')
def run(tmp_path_factory):
    """The folder of a run in process that has finished."""
    folder = tmp_path_factory.mktemp('runs') / 'run'
    settings = tiny(method='uniform', steps=400, warmup_steps=200, threads=1, evaluate_every=0)
    done(settings.changed({'sac.updates_per_step': 0.01}), folder)
    return folder


@pytest.mark.parametrize(
    ('flags', 'reason'),
    [
        ((), 'has finished its 400 steps: give more, with --resume .* --steps N'),
        (('--steps', '300'), '--steps 300: the run in .* has 400, and can only get longer'),
        (('--seed', '3'), 'has seed = 0 .now 3.: a run goes on with the settings .* only steps'),
        (('--config', 'cpu'), 'goes on with the settings of the run: leave out --config'),
        (('--out', 'there'), 'goes on with a run as it began: leave out --out'),
        (('--no-bag',), 'goes on with a run as it began: leave out --no-bag'),
    ],
)
def test_what_cannot_go_on_is_refused_with_the_remedy(flags, reason, run, capsys):
    before = {path: path.read_bytes() for path in run.rglob('*') if path.is_file()}
    assert train.main(['--resume', str(run), *flags]) == 2
    assert re.search(reason, ' '.join(capsys.readouterr().err.split()))
    assert before == {path: path.read_bytes() for path in run.rglob('*') if path.is_file()}


def test_a_folder_that_is_no_run_or_of_another_version_is_refused(run, tmp_path, capsys):
    assert train.main(['--resume', str(tmp_path)]) == 2
    assert 'is not the folder of a run, it has no config.yaml' in capsys.readouterr().err
    assert train.main(['--resume']) == 2
    assert '--resume needs the folder of a run' in capsys.readouterr().err
    made = origin.read(run)
    (tmp_path / 'config.yaml').write_text((run / 'config.yaml').read_text())
    assert train.main(['--resume', str(tmp_path)]) == 2
    assert 'has no run.json' in capsys.readouterr().err
    other = made.versions | {'codetr_ros': '0.0.1'}
    origin.write(tmp_path, made.model_copy(update={'versions': other}))
    assert train.main(['--resume', str(tmp_path)]) == 2
    assert 'begun with codetr_ros 0.0.1, this is' in capsys.readouterr().err
    origin.write(tmp_path, made.model_copy(update={'recorded': False}))
    assert train.main(['--resume', str(tmp_path)]) == 2
    assert 'was made with --no-bag' in capsys.readouterr().err


@pytest.mark.parametrize('text', ['steps: [}', 'steps: -3', ''])
def test_damaged_settings_are_refused_with_the_remedy(text, run, tmp_path, capsys):
    (tmp_path / 'config.yaml').write_text(text)
    (tmp_path / 'run.json').write_text((run / 'run.json').read_text())
    assert train.main(['--resume', str(tmp_path)]) == 2
    refused = capsys.readouterr().err
    assert f'{tmp_path}/config.yaml' in refused
    assert 'restore config.yaml from a copy, or start the run again' in refused


def test_what_can_be_made_again_may_be_gone_or_damaged(run, tmp_path):
    folder = tmp_path / 'run'
    shutil.copytree(run, folder)
    for name in ('logs', 'nodes'):
        shutil.rmtree(folder / name)
    for name in ('metrics.csv', 'report.html', 'status.json', 'bag/metadata.yaml'):
        (folder / name).unlink()
    (folder / 'summary.json').write_text('{')
    flags = ('--resume', str(folder), '--steps', '600', '--no-film')
    summary, said = finish(codetr('train', *flags, environment=ENVIRONMENT), folder)
    assert summary['steps'] == 600
    assert 'summary.json is not JSON' in said
    assert 'it is made again' in said
    assert verify(folder / 'bag').sound


def test_a_file_in_the_place_of_a_folder_is_named(run, tmp_path, capsys):
    folder = tmp_path / 'run'
    shutil.copytree(run, folder)
    shutil.rmtree(folder / 'logs')
    (folder / 'logs').write_text('mine')
    assert train.main(['--resume', str(folder), '--steps', '600', '--no-film']) == 2
    assert f'folder {folder}/logs cannot be made (File exists): remove' in ' '.join(
        capsys.readouterr().err.split()
    )


def test_a_run_that_is_under_way_is_left_alone(run, capsys, monkeypatch):
    monkeypatch.setattr(launcher, 'STOP_DEADLINE', 0.3)  # for nodes that are ending
    with held(run):
        assert train.main(['--resume', str(run), '--steps', '600', '--no-film']) == 2
    assert 'is under way in another process' in capsys.readouterr().err


def test_a_run_that_was_killed_before_it_had_begun_is_begun_again(tmp_path, capsys):
    settings = tiny(method='uniform', steps=400, warmup_steps=200, threads=1, evaluate_every=0)
    folder = run_folder.create(tmp_path / 'run')
    origin.write(folder, origin.origin(settings, 'before', '/run_before', True, True, None))
    (folder / '.config.yaml.7.partial').touch()
    assert train.main(['--resume', str(folder)]) == 2
    assert f'nothing is lost. Start it again, with --out {folder}' in ' '.join(
        capsys.readouterr().err.split()
    )
    assert done(settings, folder)['steps'] == 400
    assert not list(folder.glob('.*'))
    assert origin.read(folder).run_id != 'before'


def test_a_run_that_was_killed_when_it_had_just_begun_goes_on(tmp_path, capsys):
    settings = tiny(method='uniform', steps=400, warmup_steps=200, threads=1, evaluate_every=0)
    folder = run_folder.create(tmp_path / 'run')
    origin.write(folder, origin.origin(settings, 'run', '/run_run', True, True, None))
    run_folder.write_settings(folder, settings)
    again = ['--config', str(folder / 'config.yaml'), '--out', str(folder), '--in-process']
    assert train.main(again) == 2
    assert f'codetr train --resume {folder}' in ' '.join(capsys.readouterr().err.split())
    flags = ('--resume', str(folder), '--no-film')
    summary, _ = finish(codetr('train', *flags, environment=ENVIRONMENT), folder)
    assert summary['steps'] == 400


def test_a_bag_without_the_settings_of_its_run_is_refused_with_the_remedy(tmp_path, capsys):
    (tmp_path / 'bag').mkdir()
    assert train.main(['--resume', str(tmp_path)]) == 2
    assert 'has a bag and no config.yaml: restore that from a copy' in ' '.join(
        capsys.readouterr().err.split()
    )
