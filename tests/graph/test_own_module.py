"""An environment of somebody's own over topics: nodes import the module that its name names."""

import json
import os
import subprocess
import sys

import pytest
import yaml

from codetr_ros.bags.verify import verify
from helpers.builders import tiny
from helpers.runs import DEADLINE, logs

MODULE = """
import random
import gymnasium
import numpy as np
from gymnasium.spaces import Box

class Arm(gymnasium.Env):
    observation_space = Box(-np.inf, np.inf, (2,), np.float64)
    action_space = Box(-1.0, 3.0, (1,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = np.array([self.np_random.uniform(-1, 1), 0.0])
        return self.state, {}

    def step(self, action):
        action *= 0.1  # in place
        self.state[:] = self.state[0] + action[0] + random.gauss(0, 0.1), self.state[1] + 1
        lost = random.random() < 0.05
        return self.state, -abs(self.state[0]), bool(self.state[0] > 3), lost, {}

class Bonus(gymnasium.RewardWrapper):
    def reward(self, reward):
        return reward + 10

gymnasium.register('Arm-v0', lambda: Bonus(Arm()), max_episode_steps=50)
"""
SCRIPT = """
import sys
from codetr_ros.cli import main
sys.exit(main(['train', *sys.argv[1:]]))
"""


@pytest.mark.slow
def test_a_task_of_ones_own_module_is_learnt_over_topics_as_in_process(tmp_path):
    # nodes do not look beside the script, from which this process imports the module
    (tmp_path / 'scripts').mkdir()
    (tmp_path / 'scripts' / 'own_arm.py').write_text(MODULE)
    (tmp_path / 'scripts' / 'learn.py').write_text(SCRIPT)
    settings = tiny(task='own_arm:Arm-v0')
    config = tmp_path / 'config.yaml'
    config.write_text(yaml.safe_dump(settings.model_dump(mode='json')))
    ended = {}
    for way in ('topics', 'calls'):
        folder = tmp_path / way
        more = ['--in-process'] if way == 'calls' else []
        command = [sys.executable, tmp_path / 'scripts' / 'learn.py', '--config', config]
        done = subprocess.run(
            [*command, '--out', folder, *more],
            cwd=tmp_path,
            env=os.environ | {'COLUMNS': '160'},
            capture_output=True,
            text=True,
            timeout=DEADLINE,
            check=False,
        )
        assert done.returncode == 0, f'{done.stdout}{done.stderr}{logs(folder)}'
        ended[way] = json.loads((folder / 'summary.json').read_text())
    topics, calls = ended['topics'], ended['calls']
    for what in ('policy_sha256', 'reward_model_sha256', 'evaluations', 'reward_recovery'):
        assert topics[what] == calls[what], what
    # the rewards of the wrapper, and episodes that the environment itself cut off
    last = topics['evaluations'][-1]
    assert last['true_return_mean'] > 0
    assert last['length_mean'] < 50
    assert topics['task'] == 'own_arm:Arm-v0'
    assert topics['task_module'] == str(tmp_path / 'scripts' / 'own_arm.py')
    assert topics['versions']['own_arm'] is None
    assert verify(tmp_path / 'topics' / 'bag').sound
