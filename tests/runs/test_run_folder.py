import os
from pathlib import Path

import pytest

from codetr_ros import config
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs import reports as node_reports
from codetr_ros.runs.folder import RunFolderError
from codetr_ros.runs.reports import NodeReport
from codetr_ros.system.files import atomic_write


def test_a_new_folder_gets_the_places_that_every_run_has(tmp_path: Path) -> None:
    folder = run_folder.create(tmp_path / 'runs' / 'first')

    assert folder == tmp_path / 'runs' / 'first'
    assert sorted(p.name for p in folder.iterdir()) == ['checkpoints', 'logs', 'nodes']


def test_an_empty_folder_that_exists_is_taken(tmp_path: Path) -> None:
    assert run_folder.create(tmp_path) == tmp_path


def test_a_folder_that_holds_something_is_refused_and_left_alone(tmp_path: Path) -> None:
    for name in ('d', 'a', 'c', 'b'):
        (tmp_path / name).touch()

    with pytest.raises(RunFolderError) as refused:
        run_folder.create(tmp_path)

    assert str(refused.value) == (
        f'output folder {tmp_path} exists and is not empty (a, b, c, ...): '
        'choose another with --out, or remove it'
    )
    assert len(list(tmp_path.iterdir())) == 4


LEFT = ('run.json', '.run.json.7.partial', '.config.yaml.7.partial')
"""Files of a start that was killed."""


def test_a_folder_of_a_run_that_was_killed_before_it_had_begun_is_taken_again(tmp_path):
    folder = tmp_path / 'run'
    for files in ((), *((name,) for name in LEFT), LEFT):
        run_folder.create(folder)
        for name in files:
            (folder / name).write_text('{')
        assert run_folder.has_only_begun(folder)
        run_folder.begin_anew(run_folder.create(folder))
        assert sorted(p.name for p in folder.iterdir()) == ['checkpoints', 'logs', 'nodes']


@pytest.mark.parametrize('name', ['config.yaml', 'bag/a', 'logs/sim.log', 'checkpoints/learner-1'])
def test_a_folder_that_holds_anything_of_a_run_is_not(tmp_path, name):
    folder = run_folder.create(tmp_path / 'run')
    for file in ('run.json', name):
        (folder / file).parent.mkdir(exist_ok=True)
        (folder / file).touch()
    assert not run_folder.has_only_begun(folder)
    for refused in (run_folder.create, run_folder.begin_anew):
        with pytest.raises(RunFolderError, match='is not empty') as caught:
            refused(folder)
        goes_on = f'goes on with `codetr train --resume {folder}`' in str(caught.value)
        assert goes_on == (name == 'config.yaml')
    assert (folder / name).is_file()


def test_runs_that_begin_in_the_same_second_have_folders_of_their_own(tmp_path: Path) -> None:
    name = tmp_path / 'runs' / 'task-20260101-120000'

    folders = [run_folder.create_next(name) for _ in range(3)]

    assert [folder.name.removeprefix(name.name) for folder in folders] == ['', '-2', '-3']
    assert all((folder / run_folder.NODES).is_dir() for folder in folders)


def test_a_file_in_the_place_of_the_folder_is_refused(tmp_path: Path) -> None:
    file = tmp_path / 'file'
    file.touch()

    with pytest.raises(RunFolderError, match=f'output folder {file} is a file'):
        run_folder.create(file)
    with pytest.raises(RunFolderError, match=f'{file} cannot be written'):
        run_folder.create(file / 'run')


def test_a_place_that_cannot_be_written_is_refused_by_name() -> None:
    # /proc refuses new folders to everybody, root included.
    with pytest.raises(RunFolderError, match=r'output folder /proc/run cannot be made.*--out'):
        run_folder.create(Path('/proc/run'))


@pytest.mark.skipif(os.geteuid() == 0, reason='root may write everywhere')
def test_a_folder_without_write_permission_is_refused(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)

    with pytest.raises(RunFolderError, match='change its permissions'):
        run_folder.create(tmp_path / 'run')


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / 'summary.json'
    atomic_write(path, 'old')

    def full(*_: object) -> None:
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr(os, 'fsync', full)
    with pytest.raises(OSError, match='No space left'):
        atomic_write(path, 'new, and longer')

    assert path.read_text() == 'old'
    assert [p.name for p in tmp_path.iterdir()] == ['summary.json']


def test_bytes_and_text_are_written_and_replaced(tmp_path: Path) -> None:
    path = tmp_path / 'file'

    atomic_write(path, 'Größe')
    assert path.read_text(encoding='utf-8') == 'Größe'
    atomic_write(path, b'\x00\xff')
    assert path.read_bytes() == b'\x00\xff'


@pytest.mark.parametrize('preset', config.PRESETS)
def test_the_settings_of_a_run_are_read_back_as_they_were(tmp_path: Path, preset: str) -> None:
    settings = config.load(preset)

    run_folder.write_settings(tmp_path, settings)

    assert run_folder.read_settings(tmp_path) == settings
    assert run_folder.read_settings(tmp_path).hash() == settings.hash()


def test_a_folder_that_no_run_has_made_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        RunFolderError, match=r'is not the folder of a run, it has no config\.yaml'
    ):
        run_folder.read_settings(tmp_path)


def test_node_reports_are_found_by_role_and_name(tmp_path: Path) -> None:
    sim = NodeReport(role='sim', name='/run_x/sim_2', published={'task': 1})
    node_reports.write(run_folder.report_path(tmp_path, 'sim', '/run_x/sim_2'), sim)
    learner = NodeReport(role='learner', name='given', finished=True)
    node_reports.write(run_folder.report_path(tmp_path, 'learner', 'learner'), learner)

    read = node_reports.read_all(tmp_path)
    reports = {name: report.model_dump(exclude_unset=True) for name, report in read.items()}

    assert reports == {
        'sim-sim_2': {'role': 'sim', 'name': '/run_x/sim_2', 'published': {'task': 1}},
        'learner-learner': {'role': 'learner', 'name': 'given', 'finished': True},
    }
    assert run_folder.report_path(tmp_path, 'sim', 'sim_2').is_file()


@pytest.mark.parametrize(('text', 'said'), [('{', 'is not JSON'), ('[1]', 'holds list')])
def test_a_damaged_node_report_is_refused_by_name(tmp_path: Path, text: str, said: str) -> None:
    path = run_folder.report_path(tmp_path, 'sim', 'sim')
    path.parent.mkdir()
    path.write_text(text)

    with pytest.raises(RunFolderError, match=rf'{path} {said}'):
        node_reports.read_all(tmp_path)
