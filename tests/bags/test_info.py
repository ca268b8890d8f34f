import json
import math
from dataclasses import replace

import pytest
from rosbags.rosbag2 import StoragePlugin

from codetr_ros.bags.info import Range, survey
from codetr_ros.cli import main
from codetr_ros.records import CompositeReward, RunSpec
from helpers.arm import NOON, attempt, bag
from helpers.bags import WRITERS, a_run, ours


@pytest.mark.parametrize('writer', ['ours', 'rosbags-sqlite-9', 'mcap-lz4'])
def test_what_is_in_a_bag_is_counted(writer, tmp_path):
    records = a_run(phases=3)
    found = survey(WRITERS[writer](tmp_path / 'bag', records))
    (run,) = found['runs']
    assert run['run_id'] == 'run' and run['namespace'] == '/run'
    assert run['settings']['delay'] == 5 and run['settings']['method'] == 'codetr'
    assert (run['steps'], run['episodes'], run['segments_scored']) == (60, 4, 12)
    assert run['phases'] == {'count': 3, 'min': 0, 'max': 2, 'mean': 1}
    values = [record.value for record in records if isinstance(record, CompositeReward)]
    assert run['scores']['min'] == min(values) and run['scores']['max'] == max(values)
    assert run['sources']['sim'] | {'task': ''} == {
        'task': '', 'observation_size': 3, 'action_size': 2, 'horizon': 1000,
        'steps': 60, 'steps_dropped': 0, 'phases_dropped': 0, 'chunks': 12, 'episodes': 4,
        'terminated': 0, 'truncated': 4,
    }  # fmt: skip
    assert found['topics']['/run/transitions']['messages'] == 12
    assert found['faults'] == 0


@pytest.mark.parametrize('storage', [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_begin_and_duration_are_those_of_all_messages_whoever_wrote_them(
    storage, tmp_path, capsys
):
    sent = attempt(40)
    made = bag(tmp_path / 'bag', sorted(sent, key=lambda one: one.topic), storage)
    found = survey(made)
    assert (found['first_ns'], found['last_ns']) == (NOON, NOON + 800_000_000)
    assert main(['bag', 'info', str(made)]) == 0
    said = capsys.readouterr().out
    assert '2023-11-14 22:13:20.000 UTC' in said and '0.800 s' in said


def test_info_shows_tables_and_json(tmp_path, capsys):
    bag = ours(tmp_path / 'bag', a_run())
    assert main(['bag', 'info', str(bag)]) == 0
    said = capsys.readouterr().out
    assert 'segments scored' in said and '/run/transitions' in said and '12' in said
    assert main(['bag', 'info', str(bag), '--json']) == 0
    assert json.loads(capsys.readouterr().out)['runs'][0]['steps'] == 60


@pytest.mark.parametrize('command', ['info', 'verify'])
def test_names_that_look_like_markup_are_shown_as_they_are(command, tmp_path, capsys):
    bag = ours(tmp_path / 'seed [red]1[/]', a_run(run_id='a [/x] run'))
    assert main(['bag', command, str(bag)]) == 0
    said = ''.join(capsys.readouterr().out.split())  # it may be wrapped anywhere
    assert 'a[/x]run' in said and 'seed[red]1[/]' in said


@pytest.mark.parametrize('command', ['info', 'verify', 'recover'])
def test_the_folder_of_a_run_stands_for_its_bag(command, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv('COLUMNS', '300')  # however long the path is, it is not wrapped
    ours(tmp_path / 'run' / 'bag', a_run())
    (tmp_path / 'run' / 'config.yaml').touch()
    out = ['--out', str(tmp_path / 'new')] if command == 'recover' else []
    assert main(['bag', command, str(tmp_path / 'run'), *out]) == 0, capsys.readouterr().err
    assert str(tmp_path / 'run' / 'bag') in capsys.readouterr().out


def test_faults_are_counted_and_said(tmp_path, capsys):
    bag = ours(tmp_path / 'bag', a_run())
    path = bag / 'bag_0.mcap'
    path.write_bytes(path.read_bytes()[:3000])
    assert main(['bag', 'info', str(bag)]) == 0
    assert 'codetr bag verify' in capsys.readouterr().out.replace('\n', ' ')


def test_what_is_no_bag_is_refused(tmp_path, capsys):
    assert main(['bag', 'info', str(tmp_path)]) == 2
    assert 'holds no file of .mcap or .db3' in capsys.readouterr().err
    assert main(['bag', 'turn']) == 2
    assert "no command 'bag turn'" in capsys.readouterr().err


@pytest.mark.parametrize('wrong', [math.nan, math.inf, -math.inf])
def test_numbers_that_are_not_finite_are_counted_and_the_json_is_json(wrong, tmp_path, capsys):
    records = a_run()
    at = next(i for i, r in enumerate(records) if isinstance(r, CompositeReward))
    records[at] = replace(records[at], value=wrong)
    settings = '{"delay": NaN, "steps": [1e999], "seed": 3}'
    records = [replace(r, settings=settings) if isinstance(r, RunSpec) else r for r in records]
    bag = ours(tmp_path / 'bag', records)
    assert main(['bag', 'info', str(bag), '--json']) == 0

    def refuse(word):
        raise AssertionError(f'{word} is not JSON')

    (run,) = json.loads(capsys.readouterr().out, parse_constant=refuse)['runs']
    values = [r.value for r in records if isinstance(r, CompositeReward)]
    values = [value for value in values if math.isfinite(value)]
    assert run['scores'] == {
        'count': 11, 'min': min(values), 'max': max(values), 'not_finite': 1,
        'mean': pytest.approx(sum(values) / 11),
    }  # fmt: skip
    assert run['segments_scored'] == 12
    assert run['settings'] == {'delay': 'nan', 'steps': '[inf]', 'seed': 3}
    assert main(['bag', 'info', str(bag)]) == 0
    assert '1 not finite' in capsys.readouterr().out


def test_the_mean_of_the_largest_numbers_is_a_number():
    found = Range()
    for value in (1.7e308, 1.7e308, -1.0, 1.7e308):
        found.add(value)
    assert found.report()['mean'] == pytest.approx(1.275e308)
