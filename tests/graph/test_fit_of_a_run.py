"""A run over topics, and what its bag teaches afterwards without them."""

import json
import subprocess
import sys

import pytest

from helpers.builders import tiny
from helpers.runs import DEADLINE, train

BLOCKED = """
import sys
for name in ('rclpy', 'codetr_msgs', 'rosidl_runtime_py', 'rosidl_generator_py'):
    sys.modules[name] = None
from codetr_ros import cli
sys.exit(cli.main(sys.argv[1:]))
"""


@pytest.mark.slow
def test_folding_the_bag_of_a_run_over_topics_ends_with_its_weights_and_needs_no_ros(tmp_path):
    settings = tiny(task='Reacher-v5', overlap=True, sac__updates_per_step=0.1, evaluate_every=0)
    run, _ = train(settings, tmp_path / 'run')

    fit = ['fit', str(tmp_path / 'run'), '--schedule', 'phases', '--out', str(tmp_path / 'fit')]
    done = subprocess.run(
        [sys.executable, '-c', BLOCKED, *fit],
        capture_output=True,
        text=True,
        timeout=DEADLINE,
        check=False,
    )

    assert done.returncode == 0, done.stderr
    said = json.loads((tmp_path / 'fit' / 'summary.json').read_text())
    assert said['reward_model_sha256'] == run['reward_model_sha256']
    assert said['live_reward_model_sha256'] == run['reward_model_sha256']
    assert said['recorded_labels']['other'] == 0
    assert said['recorded_labels']['same'] > 100
