"""`codetr report` makes of a folder what the end of `codetr train` makes."""

import json
from pathlib import Path
from typing import Any

import pytest

from codetr_ros import cli
from codetr_ros.cli import report
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs import reports, run_summary
from codetr_ros.runs.reports import NodeReport
from codetr_ros.runs.summary import Summary
from helpers.bags import ours
from helpers.benchmark_folders import benchmark
from helpers.builders import run, tiny
from helpers.summaries import REPORTED, SETTINGS, Clock, a_run

FILES = (run_folder.SUMMARY, run_folder.METRICS, run_folder.REPORT, run_folder.PICTURE)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """What nodes leave that nobody has watched: a bag and their reports."""
    ours(tmp_path / run_folder.BAG, [run(SETTINGS, 'r'), *a_run()])
    run_folder.write_settings(tmp_path, SETTINGS)
    for made in REPORTED.values():
        node = NodeReport.model_validate({'name': made['role'], **made, 'bag': None})
        reports.write(run_folder.report_path(tmp_path, node.role, node.name), node)
    return tmp_path


def summary_of(folder: Path) -> dict[str, Any]:
    return json.loads((folder / run_folder.SUMMARY).read_text())


def watched() -> dict[str, Any]:
    """The summary of somebody who has received every record."""
    made = Summary(SETTINGS, 'r', False, Clock())
    for record in a_run():
        made.receive(record)
    return made.build({}).model_dump(mode='json')


def test_nodes_that_nobody_watched_get_the_summary_of_a_watched_run(folder, capsys):
    assert cli.main(['report', '--no-film', str(folder)]) == 0

    said, due = summary_of(folder), watched()
    for name in ('run_id', 'steps', 'phases', 'evaluations', 'random', 'settings', 'final_score'):
        assert said[name] == due[name], name
    assert said['updates'] == 1500
    assert (said['interrupted'], said['failure']) == (False, None)
    assert said['bag'] == str(folder / run_folder.BAG)
    assert said['wall_s'] == 9.0, 'that of the node that ran longest'
    assert 'codetr' not in said['processes'], 'it was no process of the run'
    assert all((folder / name).stat().st_size for name in FILES)
    shown = capsys.readouterr().out
    assert 'true return, random policy to 2500 steps' in shown
    assert str(folder / run_folder.REPORT) in shown


def test_what_the_command_that_did_the_run_knew_is_kept(folder):
    assert cli.main(['report', '--no-film', str(folder)]) == 0
    before = run_summary.read(folder / run_folder.SUMMARY)
    known = before.model_copy(
        update={
            'failure': 'sim was ended by SIGKILL',
            'wall_s': 77.0,
            'versions': {'torch': '1'},
            'processes': before.processes | {'codetr': before.processes['sim-sim']},
        }
    )
    run_summary.write(folder, known)
    for name in (run_folder.METRICS, run_folder.REPORT, run_folder.PICTURE):
        (folder / name).unlink()

    assert cli.main(['report', '--no-film', str(folder)]) == 0

    assert run_summary.read(folder / run_folder.SUMMARY).model_dump(
        exclude={'steps_per_s'}
    ) == known.model_dump(exclude={'steps_per_s'})
    assert all((folder / name).stat().st_size for name in FILES)


def test_nodes_that_gave_up_or_were_stopped_are_a_failure_or_an_interruption(folder):
    path = run_folder.report_path(folder, 'learner', 'learner')
    stopped = reports.read(path).model_copy(update={'finished': False})
    reports.write(path, stopped)
    assert cli.main(['report', '--no-film', str(folder)]) == 0
    assert (summary_of(folder)['interrupted'], summary_of(folder)['failure']) == (True, None)

    reports.write(path, stopped.model_copy(update={'error': 'training has diverged'}))
    assert cli.main(['report', '--no-film', str(folder)]) == 0
    assert summary_of(folder)['failure'] == 'learner: training has diverged'

    other = run_folder.report_path(folder, 'record', 'record')
    gone = {'wall_s': 1.0, 'finished': False, 'error': 'sim is silent'}
    reports.write(other, reports.read(other).model_copy(update=gone))
    assert cli.main(['report', '--no-film', str(folder)]) == 0
    said = summary_of(folder)['failure']
    assert said == 'record: sim is silent; learner: training has diverged', 'the first one first'


def test_a_simulator_that_has_left_the_run_is_neither_failure_nor_interruption():
    settings = tiny(joiners=('arm_2',))
    left = NodeReport(role='sim', name='arm_2', finished=False)
    for error in (None, 'no room'):
        gone = {'sim-arm_2': left.model_copy(update={'error': error})}
        needed = report._needed(settings, gone)
        assert (report._interrupted(needed), report._failure(needed)) == (False, None)
        gone['sim-sim'] = gone['sim-arm_2'].model_copy(update={'name': 'sim'})
        needed = report._needed(settings, gone)
        why = None if error is None else 'sim: no room'
        assert (report._interrupted(needed), report._failure(needed)) == (error is None, why)


def test_the_bag_of_a_killed_recorder_is_read_as_far_as_it_goes(folder, capsys):
    file = next((folder / run_folder.BAG).glob('*.mcap'))
    (folder / run_folder.BAG / 'metadata.yaml').unlink()
    # within the records: a third or more of a bag this small are definitions, before and behind
    file.write_bytes(file.read_bytes()[: int(file.stat().st_size * 0.51)])

    assert cli.main(['report', '--no-film', str(folder)]) == 0

    said = summary_of(folder)
    assert (
        0 < said['phases'] <= 3
        and said['evaluations'] == watched()['evaluations'][: len(said['evaluations'])]
    )
    assert 'what can be read of the bag' in capsys.readouterr().out


def test_of_a_run_without_a_bag_report_and_picture_are_made_again(folder):
    assert cli.main(['report', '--no-film', str(folder)]) == 0
    before = (folder / run_folder.SUMMARY).read_bytes()
    for path in (folder / run_folder.BAG).iterdir():
        path.unlink()
    (folder / run_folder.BAG).rmdir()
    (folder / run_folder.REPORT).unlink()

    assert cli.main(['report', '--no-film', str(folder)]) == 0

    assert (folder / run_folder.SUMMARY).read_bytes() == before
    assert (folder / run_folder.REPORT).stat().st_size


def test_the_report_of_a_run_that_was_moved_names_its_bag_where_it_is(folder, tmp_path):
    path = run_folder.report_path(folder, 'record', 'record')
    before = NodeReport.model_validate_json(path.read_text())
    reports.write(path, before.model_copy(update={'bag': '/where/it/was/bag'}))

    assert cli.main(['report', '--no-film', str(folder)]) == 0

    assert summary_of(folder)['bag'] == str(tmp_path / run_folder.BAG)
    assert '/where/it/was' not in (folder / run_folder.REPORT).read_text()


@pytest.mark.parametrize(
    ('what', 'said'),
    [
        ('none', 'there is no folder'),
        ('other/bag', 'holds neither a bag nor a summary.json'),
        ('other/bag', 'give the folder of the run, {}/other. Nodes leave'),
        ('other/bag/metadata.yaml', 'is a file: give the folder of the run, {}/other'),
        ('empty', 'holds neither a bag nor a summary.json'),
        ('fit', 'is the folder of a fit, whose report is {}/fit/report.html'),
        ('listed', 'holds list, not an object'),
        ('two', 'holds 2 runs (r, s): give the folder of one run'),
        ('other', 'bag holds no run'),
    ],
)
def test_a_folder_without_a_run_is_refused(what, said, tmp_path, capsys):
    (tmp_path / 'empty').mkdir()
    for name, content in (('fit', {'fit': {'method': 'mlp'}}), ('listed', [])):
        (tmp_path / name).mkdir()
        (tmp_path / name / run_folder.SUMMARY).write_text(json.dumps(content))
    both = [run(SETTINGS, 'r'), run(SETTINGS, 's')]
    ours(tmp_path / 'two' / run_folder.BAG, [*both, *a_run()])
    ours(tmp_path / 'other' / run_folder.BAG, a_run())

    assert cli.main(['report', str(tmp_path / what)]) == cli.USAGE

    assert said.format(tmp_path) in capsys.readouterr().err
    made = [path.parent.name for path in tmp_path.rglob(run_folder.SUMMARY)]
    assert sorted(made) == ['fit', 'listed']


def test_the_folder_of_a_benchmark_gets_the_report_of_a_benchmark(tmp_path, capsys):
    made = benchmark(tmp_path / 'b', lambda cell: 0.25, methods=['none'])
    assert made.path.joinpath(report.BENCHMARK).is_file()

    assert cli.main(['report', str(made.path)]) == 0

    assert '0.2500 (0.0000)*' in capsys.readouterr().out
    assert (made.path / 'report' / 'index.html').is_file()
