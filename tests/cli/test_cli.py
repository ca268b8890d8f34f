import json
import os
import platform
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from datetime import datetime
from pathlib import Path

import pytest

from codetr_ros import cli, config
from codetr_ros.cli import flags, train
from codetr_ros.config import Settings, SettingsError
from codetr_ros.processes import launcher
from codetr_ros.records import ROLES
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs import run_summary, segments
from helpers.executables import prefix

SMALL = {
    'task': 'InvertedDoublePendulum-v5',
    'delay': 25,
    'codetr.base': 'none',
    'steps': 250,
    'phase-steps': 100,
    'warmup-steps': 100,
    'evaluate-every': 100,
    'evaluate-episodes': 2,
    'codetr.layers': 1,
    'codetr.embedding': 8,
    'codetr.first-gradient-steps': 2,
    'codetr.gradient-steps': 1,
    'sac.hidden': 8,
    'sac.batch': 8,
}
TINY = ['--no-film', *(f'--{name}={value}' for name, value in SMALL.items())]
"""Flags of a run that takes seconds."""


@pytest.fixture(autouse=True)
def _environment_as_it_was() -> Iterator[None]:
    """`codetr train` sets variables for this process and those that it starts."""
    before = dict(os.environ)
    yield
    for name in os.environ.keys() - before.keys():
        del os.environ[name]
    os.environ.update(before)


def parse(*arguments: str) -> Settings:
    return flags.parse(arguments, 'codetr train', 'Train.', 'quick')[0]


def test_without_flags_the_quick_preset_is_trained() -> None:
    assert parse() == config.load('quick')


def test_the_chosen_config_decides_the_defaults_that_other_flags_override(tmp_path: Path) -> None:
    file = tmp_path / 'mine.yaml'
    file.write_text('delay: 7\nsteps: 999\n')

    assert parse('--config', 'paper') == config.load('paper')
    assert parse('--delay', '50', '--config=cpu') == config.load('cpu').changed({'delay': 50})
    for delay in ('10:50', 'episode'):
        assert parse('--delay', delay) == config.load('quick').changed({'delay': delay})
    mine = parse('--config', str(file), '--steps', '1000')
    assert (mine.delay, mine.steps) == (7, 1000)


@pytest.mark.parametrize('name', config.load('quick').flat())
def test_every_setting_is_a_flag(name: str) -> None:
    value = config.load('paper').flat()[name]
    flag = '--' + name.replace('_', '-')
    if isinstance(value, bool):
        group, _, last = flag.rpartition('.')
        negated = f'{group}.no-{last}' if group else f'--no-{last[2:]}'
        given = [flag if value else negated]
    elif isinstance(value, tuple):
        given = [flag, *map(str, value)]
    else:
        given = [flag, str(value)]

    parsed = (
        parse(*given)
        if name not in ('codetr.heads',)
        else parse(*given, '--codetr.embedding', '64')
    )

    assert parsed.flat()[name] == value


def test_help_shows_the_defaults_and_ranges_of_the_chosen_config(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as left:
        parse('--config', 'paper', '--help-all')

    assert left.value.code == 0
    shown = ' '.join(capsys.readouterr().out.replace('│', ' ').split())
    assert '--codetr.layers INT causal transformer layers [>= 1, <= 24] (default: 3)' in shown
    assert 'Ant-v4' in shown


@pytest.mark.parametrize(
    ('arguments', 'said'),
    [
        ('--delay 0', 'delay = 0: a segment has 1 to 100000 steps'),
        ('--steps -5', 'steps = -5: Input should be greater than or equal to 1'),
        ('--codetr.heads 3', 'embedding=64 is not divisible by heads=3'),
        ('--config slow', "config 'slow' is neither a preset (quick, cpu, paper) nor a file"),
        ('--config qiuck', 'nor a file (did you mean quick?)'),
        ('--config', '--config needs a value: quick, cpu, paper or a YAML file'),
        ('--task Ant-v99', "there is no task 'Ant-v99'"),
        ('--delay 1001', 'delay = 1001: task '),
        ('--method true', 'Add --in-process'),
        ('--method ones', '--method ones is a reference'),
        ('--device gpu', "device = 'gpu': must be cpu, or a GPU: cuda, or cuda and its number"),
        ('--namespace lab', "--namespace 'lab' must be a ROS namespace: /name"),
        ('--namespace /lab --in-process', '--in-process starts none: leave out one of them'),
        ('--joiners arm_2 --in-process', 'nobody joins a run without nodes; leave out one'),
        ('--camera /a', '--camera with --scorer simulator: no page to score is served'),
        ('--score-service', '--score-service with --scorer simulator: nobody else can score'),
        ('--peer-deadline -1', '--peer-deadline -1 must be from 0 to 86400 seconds'),
    ],
)
def test_what_cannot_be_trained_is_refused_before_anything_is_made(
    arguments: str,
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)

    assert cli.main(['train', *arguments.split()]) == 2

    shown = capsys.readouterr()
    assert said in shown.err
    assert 'Traceback' not in shown.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize('arguments', ['--stepz 3', '--steps many', '--composite mean'])
def test_a_flag_that_cannot_be_parsed_is_refused_by_name(
    arguments: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as left:
        cli.main(['train', *arguments.split()])

    assert left.value.code == 2
    assert arguments.split(maxsplit=1)[0] in capsys.readouterr().err


def test_an_output_folder_with_something_in_it_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / 'thesis.tex').touch()

    assert cli.main(['train', '--in-process', '--out', str(tmp_path)]) == 2

    assert 'exists and is not empty (thesis.tex)' in capsys.readouterr().err


def test_a_workspace_that_is_not_built_is_refused_before_a_folder_is_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, 'prefix', str(tmp_path / 'empty'))
    monkeypatch.delenv('AMENT_PREFIX_PATH', raising=False)

    assert cli.main(['train', '--out', str(tmp_path / 'run')]) == 2

    assert 'or train without nodes with --in-process' in capsys.readouterr().err
    assert not (tmp_path / 'run').exists()


def test_the_default_folder_names_task_method_seed_and_time() -> None:
    settings = config.load('quick').changed({'task': 'dm control/x y', 'seed': 3})

    assert train.default_out(settings, '20260101-120000') == (
        'runs/dm_control_x_y-codetr-3-20260101-120000'
    )


def test_commands_and_their_help_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(['--help']) == 0
    shown = capsys.readouterr().out
    assert all(f'\n  {name} ' in shown for name in cli.COMMANDS)
    for name in cli.COMMANDS:
        with pytest.raises(SystemExit) as left:
            cli.main([name, '--help'])
        assert left.value.code == 0
        assert f'usage: codetr {name}' in capsys.readouterr().out


@pytest.mark.parametrize(
    ('arguments', 'close'),
    [
        ([], ''),
        (['trian'], "no command 'trian' (did you mean train?)"),
        (['bag', 'recovr'], "no command 'bag recovr' (did you mean recover?)"),
        (['benchmark', 'reprot'], "no command 'benchmark reprot' (did you mean report?)"),
        (['--versoin'], "no option '--versoin' (did you mean --version?) in front of a command"),
        (['--task', 'Hopper-v5'], "no option '--task' in front of a command: commands are train"),
        (['xyz'], "no command 'xyz': commands are"),
    ],
)
def test_no_command_or_an_unknown_one_is_refused_with_those_there_are(
    arguments: Sequence[str], close: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(arguments) == 2
    shown = capsys.readouterr().err
    assert close in shown
    one = {'bag': 'recover', 'benchmark': 'run, report'}
    assert one.get(next(iter(arguments), ''), 'evaluate') in shown


def test_the_command_line_loads_nothing_slow_before_it_must() -> None:
    program = (
        'import sys\nfrom codetr_ros import cli\n'
        'try: cli.main(sys.argv[1:])\nexcept SystemExit: pass\n'
        "slow = {'torch', 'rclpy', 'mujoco', 'matplotlib', 'gymnasium', 'dm_control'}\n"
        'print(slow & set(sys.modules), file=sys.stderr)\n'
    )
    for arguments in (['--help'], ['train', '--help'], ['train', '--delay', '0'], ['tasks']):
        done = subprocess.run(
            [sys.executable, '-c', program, *arguments], capture_output=True, text=True, check=True
        )
        assert done.stderr.splitlines()[-1] == 'set()', arguments


@pytest.mark.parametrize('command', ['convert', 'label'])
def test_a_new_bag_where_nothing_can_be_written_is_refused_before_anything_is_read(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    more = {'convert': ['--mapping', 'none.yaml'], 'label': ['--checkpoint', 'none']}[command]

    assert cli.main([command, 'no such bag', *more, '--out', '/proc/new']) == 2

    assert capsys.readouterr().err.startswith('codetr: --out /proc/new: /proc cannot be written')


def test_a_file_that_fails_where_nobody_expects_it_is_named_without_a_traceback(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def command(_: Sequence[str]) -> int:
        Path('/proc/self/made').mkdir()
        return 0

    monkeypatch.setitem(cli.COMMANDS, 'tasks', command)

    assert cli.main(['tasks']) == 1

    assert capsys.readouterr().err.startswith('codetr: /proc/self/made: No such file or dir')


def test_the_tasks_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(['tasks']) == 0

    shown = capsys.readouterr().out
    assert 'HalfCheetah-v5' in shown
    assert 'cheetah-run' in shown


@pytest.fixture(scope='module')
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a tiny run in process."""
    folder = tmp_path_factory.mktemp('runs') / 'tiny'
    assert cli.main(['train', '--in-process', '--out', str(folder), *TINY]) == 0
    return folder


def test_a_run_in_process_leaves_summary_metrics_report_and_picture(run_dir: Path) -> None:
    said = json.loads((run_dir / run_folder.SUMMARY).read_text())

    assert (said['steps'], said['phases']) == (250, 3)
    assert said['in_process']
    assert not said['interrupted']
    assert [row['step'] for row in said['evaluations']] == [100, 200, 250]
    assert said['random_score'] > 0
    assert [row['step'] for row in said['reward_recovery']] == [100, 200, 250]
    assert len(said['policy_sha256']) == len(said['reward_model_sha256']) == 64
    assert (said['lost'], said['duplicated'], said['refused']) == (0, 0, 0)
    transitions = said['messages']['transitions']
    assert transitions['published'] == transitions['received_by_learner'] > 0
    assert len((run_dir / run_folder.METRICS).read_text().splitlines()) == 5
    for name in (run_folder.REPORT, run_folder.PICTURE, run_folder.CONFIG):
        assert (run_dir / name).stat().st_size > 0
    assert run_folder.read_settings(run_dir).hash() == said['settings_hash']


def test_the_true_step_rewards_of_a_shown_segment_add_up_to_its_score(run_dir: Path) -> None:
    shown = segments.read_csv(run_dir / run_folder.STEP_REWARDS)

    assert len(shown) == 6
    for one in shown:
        assert one.value == pytest.approx(float(one.true.sum()), rel=1e-5)
        assert len(one.labels) == len(one.true)
    assert [one.value for one in shown] == sorted(one.value for one in shown)


def test_a_run_names_date_host_and_the_command_that_repeats_it(run_dir: Path) -> None:
    made = run_summary.read(run_dir / run_folder.SUMMARY)

    assert made.command == shlex.join(
        ['codetr', 'train', '--in-process', '--out', str(run_dir), *TINY]
    )
    assert datetime.fromisoformat(made.began).timestamp() == pytest.approx(time.time(), abs=3600)
    assert made.host == platform.node()


def test_evaluate_gives_what_the_runs_last_evaluation_gave(
    run_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    last = json.loads((run_dir / run_folder.SUMMARY).read_text())['evaluations'][-1]

    assert cli.main(['evaluate', str(run_dir)]) == 0

    shown = capsys.readouterr().out
    row = next(line.split() for line in shown.splitlines() if line.startswith('true return'))
    names = ('true_return_mean', 'true_return_std', 'true_return_min', 'true_return_max')
    assert row[2:] == [f'{last[name]:.6g}' for name in names]
    assert 'policy after 250 steps, 2 episodes, seed 0' in shown


def test_evaluate_takes_other_start_states_and_more_of_them(
    run_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(['evaluate', str(run_dir), '--episodes', '3', '--seed', '5']) == 0

    assert '3 episodes, seed 5' in capsys.readouterr().out


def test_evaluate_refuses_what_it_cannot_evaluate(
    run_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(['evaluate', str(tmp_path)]) == 2
    assert 'is not the folder of a run' in capsys.readouterr().err

    other = tmp_path / 'other'
    shutil.copytree(run_dir, other)
    settings = run_folder.read_settings(other).changed({'sac.hidden': (9,)})
    run_folder.write_settings(other, settings)
    assert cli.main(['evaluate', str(other)]) == 2
    assert "state of policy learner 'sac' refused: actor.body.0.weight" in capsys.readouterr().err
    assert cli.main(['evaluate', str(run_dir), '--episodes', '0']) == 2
    assert 'evaluate_episodes = 0' in capsys.readouterr().err

    run_folder.write_settings(tmp_path, config.load('quick'))
    assert cli.main(['evaluate', str(tmp_path)]) == 2
    assert 'holds no checkpoint of the learner' in capsys.readouterr().err


def test_a_policy_that_was_learnt_on_a_gpu_is_evaluated_without_one(
    run_dir: Path, tmp_path: Path
) -> None:
    folder = tmp_path / 'run'
    shutil.copytree(run_dir, folder)
    learnt = run_folder.read_settings(folder).changed({'device': 'cuda'})
    run_folder.write_settings(folder, learnt)
    assert cli.main(['evaluate', str(folder), '--episodes', '1']) == 0


@pytest.mark.slow
def test_ctrl_c_ends_a_run_in_process_with_a_checkpoint_and_a_summary(tmp_path: Path) -> None:
    folder = tmp_path / 'run'
    command = [sys.executable, '-m', 'codetr_ros.cli', 'train', '--in-process', '--out', folder]
    child = subprocess.Popen(
        [*command, *TINY, '--steps', '10000000'],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, 'PYTHONUNBUFFERED': '1'},
    )
    assert child.stdout is not None
    try:
        for line in child.stdout:
            if line.startswith('after 200 steps'):
                break
        child.send_signal(signal.SIGINT)
        shown, _ = child.communicate(timeout=180)
    finally:
        child.kill()

    assert child.returncode == cli.INTERRUPTED, shown
    assert 'Traceback' not in shown
    assert 'interrupted: what was done is kept' in shown
    said = json.loads((folder / run_folder.SUMMARY).read_text())
    assert said['interrupted']
    assert 200 <= said['steps'] < 10_000_000
    assert list((folder / run_folder.CHECKPOINTS).glob('learner-*'))


def test_the_run_over_topics_fails_with_the_log_of_the_node_that_died(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip('rclpy', reason='needs ROS')
    pytest.importorskip('codetr_msgs', reason='needs the built workspace')
    monkeypatch.setattr(sys, 'prefix', str(prefix(tmp_path / 'venv')))
    waits = (
        f'#!{sys.executable}\nimport signal, sys\n'
        'signal.signal(signal.SIGINT, lambda *_: sys.exit(0))\nsignal.pause()\n'
    )
    for role in ROLES:
        launcher.executable(role).write_text(waits)
    launcher.executable('reward').write_text('#!/bin/sh\necho out of patience >&2\nexit 7\n')

    assert cli.main(['train', '--out', str(tmp_path / 'run'), '--namespace', '/lab']) == 1

    shown = capfd.readouterr()
    assert 'namespace: /lab\n' in shown.out
    for name in ('sim', 'learner'):
        called = (tmp_path / 'run' / run_folder.LOGS / f'{name}.log').read_text()
        assert ' __ns:=/lab ' in called and called.splitlines()[0].endswith('peer_deadline:=60.0')
    assert 'the run failed: reward ended with exit code 7' in shown.err
    assert 'out of patience' in shown.err
    said = json.loads((tmp_path / 'run' / run_folder.SUMMARY).read_text())
    assert said['failure'] == 'reward ended with exit code 7'
    assert said['processes']['reward-reward']['exit_code'] == 7
    assert not said['interrupted']


def test_settings_error_is_what_the_flags_raise() -> None:
    with pytest.raises(SettingsError, match='command line: delay = 0'):
        parse('--delay', '0')


def test_help_comes_within_a_second() -> None:
    began = time.process_time()
    done = subprocess.run(
        [sys.executable, '-X', 'importtime', '-m', 'codetr_ros.cli', '--help'],
        capture_output=True,
        text=True,
        check=True,
    )
    assert time.process_time() - began < 1
    modules = [line.rsplit('|', 1)[-1].strip() for line in done.stderr.splitlines()]
    assert not {'numpy', 'pydantic', 'tyro'} & set(modules), (
        'the list of commands needs none of them'
    )
