import json

import pytest

from codetr_ros import config
from codetr_ros.runs import reports, run_summary
from codetr_ros.runs.facts import Facts, described
from codetr_ros.runs.folder import RunFolderError
from codetr_ros.runs.reports import BagReport, CoreReport, NodeReport, node_report
from codetr_ros.runs.run_summary import RunSummary
from codetr_ros.runs.summary import Summary


@pytest.fixture
def file(tmp_path):
    """The summary of a run that was stopped at once."""
    made = Summary(config.load('quick'), 'r', in_process=True).build({}, interrupted=True)
    run_summary.write(tmp_path, made)
    return tmp_path / 'summary.json'


def changed(file, **values):
    file.write_text(json.dumps({**json.loads(file.read_text()), **values}))


@pytest.mark.parametrize('kind', [RunSummary, NodeReport])
def test_every_field_of_a_summary_and_of_a_node_report_is_described(kind: type[Facts]):
    fields = list(described(kind))
    assert {field.name for field in fields} >= set(kind.model_fields)
    assert [field.name for field in fields if not field.description] == []


def test_the_fields_of_rows_and_entries_are_described_after_what_holds_them():
    names = [field.name for field in described(RunSummary)]
    assert names[names.index('evaluations') + 1] == 'evaluations[].step'
    assert names[names.index('random') + 1] == 'random.step'
    assert names[names.index('messages') + 1] == 'messages.*.published'
    assert 'memory.bytes' in [field.name for field in described(NodeReport)]


def test_a_summary_is_read_as_it_was_written(file):
    read = run_summary.read(file)
    assert (read.run_id, read.interrupted, read.steps) == ('r', True, 0)
    again = file.with_name('again')
    again.mkdir()
    run_summary.write(again, read)
    assert (again / 'summary.json').read_bytes() == file.read_bytes()


def test_a_summary_of_an_earlier_or_a_later_version_is_read(file):
    data = json.loads(file.read_text())
    del data['reward_recovery']  # which the first versions did not know
    file.write_text(json.dumps(data | {'a_field_of_tomorrow': 1}))
    assert run_summary.read(file).reward_recovery == []


def test_a_wrong_field_of_a_summary_is_named_with_its_file_and_what_to_do(file):
    changed(file, steps='many')
    with pytest.raises(RunFolderError, match=rf"summary {file}: steps = 'many': .*integer.*give"):
        run_summary.read(file)


def test_a_lacking_field_of_a_summary_is_named(file):
    file.write_text('{}')
    with pytest.raises(RunFolderError, match=rf'summary {file}: run_id: Field required'):
        run_summary.read(file)


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(RunFolderError, match=rf'summary {tmp_path}/summary.json cannot be read'):
        run_summary.read(tmp_path / 'summary.json')


def test_a_wrong_field_of_a_node_report_is_named_with_its_file_and_what_to_do(tmp_path):
    path = tmp_path / 'sim-sim.json'
    path.write_text('{"role": "sim", "name": "sim", "published": {"task": "one"}}')
    with pytest.raises(
        RunFolderError, match=rf"node report {path}: published.task = 'one': .*remove the file"
    ):
        reports.read(path)


def report(core: CoreReport, **more) -> NodeReport:
    given = {'role': 'record', 'name': 'record', 'published': {}, 'received': {'task': 1}}
    given |= {'cpu_s': 1.0, 'wall_s': 2.0, 'finished': True, 'error': None, 'refused': {}}
    return node_report(core, **given | more)


def test_what_a_node_and_its_core_have_refused_and_lost_is_added_up():
    core = CoreReport(refused={'task': 1, 'policy': 2}, lost={'policy': 3})
    made = report(core, refused={'task': 4}, lost={'task': 5})
    assert made.refused == {'task': 5, 'policy': 2}
    assert made.lost == {'policy': 3, 'task': 5}


def test_a_report_holds_what_is_known_and_nothing_else(tmp_path):
    path = tmp_path / 'record-record.json'
    made = report(CoreReport(counters={'x': 1}), own=BagReport(recorded={'task': 1}, bag=None))
    reports.write(path, made)
    written = json.loads(path.read_text())
    assert written.pop('peak_rss_mb') > 1
    assert written == {
        'role': 'record',
        'name': 'record',
        'published': {},
        'received': {'task': 1},
        'refused': {},
        'cpu_s': 1.0,
        'wall_s': 2.0,
        'finished': True,
        'error': None,
        'counters': {'x': 1},
        'recorded': {'task': 1},
        'bag': None,
    }
    assert reports.read(path) == made
