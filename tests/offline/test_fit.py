"""`codetr fit` as a user runs it: bags in, a checkpoint, a summary and a report out."""

import json
import re
import subprocess
import sys
from dataclasses import replace

import pytest
import torch
from rosbags.rosbag2 import StoragePlugin

from codetr_ros import cli, config
from codetr_ros.records import CompositeReward, RunSpec, TaskSpec, Transitions
from codetr_ros.rewards import registry
from codetr_ros.rewards.base import Predictor
from codetr_ros.rewards.learned import Learned
from codetr_ros.runs import checkpoints
from helpers.builders import run, score, transitions
from helpers.foreign_bags import write

QUICKLY = ['--gradient-steps', '30', '--check-every', '10']
WITHOUT_ROS = """
import sys
for name in ('rclpy', 'codetr_msgs', 'rosidl_runtime_py', 'rosidl_generator_py'):
    sys.modules[name] = None
from codetr_ros import cli
sys.exit(cli.main(sys.argv[1:]))
"""


def fit(*arguments, code=0):
    *bags, out = map(str, [a for a in arguments if not str(a).startswith('-')])
    flags = [a for a in arguments if str(a).startswith('-')]
    assert cli.main(['fit', *bags, '--out', out, *flags]) == code
    return json.loads((arguments[len(bags)] / 'summary.json').read_text()) if code == 0 else {}


def quickly(*arguments, code=0):
    return fit(*arguments, '--gradient-steps=30', '--check-every=10', code=code)


@pytest.mark.slow
def test_a_bag_becomes_a_checkpoint_a_summary_and_a_report_without_ros(a_run, tmp_path):
    out = tmp_path / 'out'
    done = subprocess.run(
        [sys.executable, '-c', WITHOUT_ROS, 'fit', a_run.bag, '--out', out, *QUICKLY],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert 'step 30 of at most 30' in done.stdout

    said = json.loads((out / 'summary.json').read_text())
    assert said['delay'] == a_run.settings.delay
    assert said['data']['steps'] == 1000
    assert said['most_steps_held'] <= a_run.settings.memory_steps == 700
    assert said['peak_rss_mb'] > 50
    assert set(said['metrics']) >= {'composite_r2', 'pearson', 'within_pearson', 'spearman'}
    assert said['metrics']['pearson'] is not None
    assert said['metrics']['segments_with_true_rewards'] == said['metrics']['segments'] > 10
    page = (out / 'report.html').read_text()
    pictures = re.findall(r'<img alt="([^"]+)" src="data:image/png;base64,', page)
    assert pictures == [
        'training curve',
        'predicted and true composite rewards',
        'inferred and true step rewards',
        *['a segment'] * 6,
    ]
    assert f'{said["metrics"]["composite_r2"]:.3f} on held-out episodes' in page
    assert f'correlation with the true ones {said["metrics"]["pearson"]:.3f} (Pearson)' in page

    tensors, meta = checkpoints.load(checkpoints.latest(out / 'checkpoints', 'reward'))
    settings = config.from_canonical(meta['settings'], 'checkpoint')
    method = registry.make(settings, meta['observation_size'], meta['action_size'])
    method.load_state(tensors)
    assert checkpoints.digest(method.state()) == said['reward_model_sha256']
    assert settings == config.load(str(out / 'config.yaml'))


@pytest.mark.slow
@pytest.mark.parametrize(
    'method', [m for m in registry.METHODS if m not in config.IN_PROCESS_ONLY]
)
def test_every_method_that_a_node_can_run_can_be_fitted(a_run, tmp_path, method):
    said = quickly(a_run.bag, tmp_path / 'out', f'--method={method}')

    kind = registry.METHODS[method]
    learns = issubclass(kind, Learned)
    assert (said['metrics']['composite_r2'] is not None) == issubclass(kind, Predictor)
    assert (said['best'] is not None) == learns
    assert len(said['reward_model_sha256']) == 64


@pytest.mark.parametrize('method', [*config.IN_PROCESS_ONLY, *config.SCORE_LEARNERS])
def test_what_is_no_reward_model_is_refused(a_run, tmp_path, capsys, method):
    quickly(a_run.bag, tmp_path / 'out', f'--method={method}', code=2)
    said = capsys.readouterr().err
    assert f'--method {method} ' in said
    assert 'Choose one of --method codetr|' in said


@pytest.mark.slow
def test_only_steps_and_scores_are_needed(a_run, tmp_path, capsys):
    """What a robot's own software may publish: no run, no task, no commit, no true rewards."""
    bare = [r for r in a_run.records if isinstance(r, Transitions | CompositeReward)]
    bag = write(tmp_path / 'bag', bare, storage=StoragePlugin.SQLITE3)

    said = quickly(bag, tmp_path / 'out')

    assert (said['task'], said['delay']) == ('unknown', 7)
    assert 'no bag holds the settings of a run' in said['notes'][0]
    assert said['settings']['codetr'] == config.load('quick').codetr.model_dump(mode='json')
    assert said['metrics']['pearson'] is None
    page = (tmp_path / 'out' / 'report.html').read_text()
    assert 'no bag holds the settings of a run' in page
    assert re.search('<h1>(.*?)</h1>', page)[1] == (
        'codetr fitted to the bag bag, 7 steps per score, schedule epochs'
    )
    assert 'hold no true step rewards' in page


@pytest.mark.slow
def test_several_bags_and_simulators_are_one_body_of_data(a_run, tmp_path):
    spec = next(r for r in a_run.records if isinstance(r, TaskSpec))
    other = [replace(spec, source='sim_2')] + [
        replace(r, source='sim_2', **({'scorer': 'x'} if isinstance(r, CompositeReward) else {}))
        for r in a_run.records
        if isinstance(r, Transitions | CompositeReward)
    ]
    bag = write(tmp_path / 'other', other)

    said = quickly(a_run.bag, bag, tmp_path / 'out')

    assert said['data']['steps'] == 2000
    assert said['data']['sources'] == '2: calls/sim, calls/sim_2'
    once = quickly(a_run.bag, tmp_path / 'once')
    assert said['data']['scored segments'] == 2 * once['data']['scored segments']


@pytest.mark.slow
def test_settings_come_from_the_run_a_config_or_the_flags(a_run, tmp_path):
    own = quickly(a_run.bag, tmp_path / 'own')
    assert own['settings']['codetr'] == a_run.settings.codetr.model_dump(mode='json')

    file = tmp_path / 'mine.yaml'
    file.write_text('delay: 3\ncodetr: {layers: 2, heads: 1, embedding: 8}\n')
    mine = quickly(a_run.bag, tmp_path / 'mine', f'--config={file}', '--codetr.batch=5')
    assert mine['settings']['codetr']['layers'] == 2
    assert mine['settings']['codetr']['batch'] == 5
    assert mine['delay'] == 7  # a fact of the data

    short = quickly(a_run.bag, tmp_path / 'short', '--delay=3')
    assert short['delay'] == 3
    assert short['skipped']['scores of more steps than the delay'] > 100


@pytest.mark.slow
def test_a_fit_goes_on_from_a_saved_model(a_run, tmp_path, capsys):
    first = quickly(a_run.bag, tmp_path / 'first', '--codetr.layers=2')

    again = quickly(a_run.bag, tmp_path / 'again', f'--checkpoint={tmp_path / "first"}')

    assert again['settings']['codetr']['layers'] == 2
    at = first['gradient_steps']
    assert [row['gradient_steps'] for row in again['curve']] == [at, at + 10, at + 20, at + 30]
    assert again['curve'][0]['held_out_loss'] == first['best']['held_out_loss']
    flags = [f'--checkpoint={tmp_path / "first"}', '--codetr.layers=1']
    quickly(a_run.bag, tmp_path / 'other', *flags, code=1)
    assert 'has codetr.layers = 2, here 1' in capsys.readouterr().err
    quickly(a_run.bag, tmp_path / 'other', '--frozen', code=2)
    assert 'a frozen model is not fitted' in capsys.readouterr().err


def test_what_cannot_be_fitted_is_refused_and_named(a_run, tmp_path, capsys):
    def refused(*arguments):
        fit(*arguments, tmp_path / 'out', code=2)
        assert not (tmp_path / 'out').exists()
        return capsys.readouterr().err

    assert 'is the same bag as' in refused(a_run.bag, a_run.bag)
    assert 'nowhere' in refused(tmp_path / 'nowhere')
    few = write(tmp_path / 'few', [run(), transitions(steps=7), score()])
    assert 'there is 1 episode with scores' in refused(few)
    other = write(tmp_path / 'other', [run(), transitions(steps=7), score()])
    assert 'has observation size 3' in refused(a_run.bag, other)
    assert "no Transitions of run 'mine'" in refused(a_run.bag, '--run=mine')
    (tmp_path / 'full').mkdir()
    (tmp_path / 'full' / 'x').touch()
    fit(a_run.bag, tmp_path / 'full', code=2)
    assert 'exists and is not empty (x)' in capsys.readouterr().err


@pytest.mark.slow
def test_settings_of_another_version_do_not_make_the_data_worthless(a_run, tmp_path):
    records = [
        replace(r, settings='{"delay": 7, "warp": 9}') if isinstance(r, RunSpec) else r
        for r in a_run.records
    ]
    said = quickly(write(tmp_path / 'bag', records), tmp_path / 'out')

    assert 'warp = 9: there is no such setting' in said['notes'][0]
    assert said['delay'] == 7


@pytest.mark.skipif(torch.cuda.is_available(), reason='there is a GPU here')
@pytest.mark.parametrize('schedule', ['epochs', 'phases'])
def test_a_device_that_is_not_here_is_refused_before_a_folder_is_made(
    a_run, tmp_path, capsys, schedule
):
    out = tmp_path / 'out'
    fit(a_run.bag, out, f'--schedule={schedule}', '--reward-device=cuda', code=1)
    assert 'reward_device=cuda: torch' in capsys.readouterr().err
    assert not out.exists()
