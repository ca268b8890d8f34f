"""The node that acts by a trained policy imports what a robot's computer has, and no more."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip('rclpy', reason='needs ROS')

from helpers import policies

ROOT = Path(__file__).resolve().parents[2]
IMPORTED_AS = {'PyYAML': 'yaml', 'absl-py': 'absl', 'dm-env': 'dm_env'}
PAGE = ROOT / 'docs' / 'your-robot.md'


def required() -> set[str]:
    """The packages that the library asks for, under the names by which they are imported."""
    text = (ROOT / 'codetr_ros' / 'setup.cfg').read_text()
    section = text.partition('install_requires =')[2].partition('[options.extras_require]')[0]
    names = re.findall(r'^    ([\w-]+)', section, re.MULTILINE)
    return {IMPORTED_AS.get(name, name.replace('-', '_')) for name in names}


def named() -> set[str]:
    """The packages that the page names for a robot's computer."""
    (line,) = re.findall(
        r"On the robot's computer the Python packages (.*?) are enough", PAGE.read_text()
    )
    return {IMPORTED_AS.get(name, name) for name in re.findall(r'`(\w+)`', line)}


def test_it_acts_with_the_packages_that_the_page_names_and_without_torch(tmp_path):
    policies.policy_file(tmp_path)
    others = required() - named() - {'annotated_types'}  # a part of pydantic
    assert {'torch', 'gymnasium', 'mujoco', 'mcap', 'scipy'} <= others
    program = (
        f'import sys\nfor name in {sorted(others)!r}: sys.modules[name] = None\n'
        'import learner_node.act, codetr_ros.ros.act\n'
        'from pathlib import Path\n'
        'from codetr_ros.robots.acting import driving\n'
        'from codetr_ros.robots.policy_file import load\n'
        f'file = load(Path({str(tmp_path / "policy.safetensors")!r}))\n'
        'file.test()\n'
        'driving(file, file.described.robot.mapping)\n'
        f'print([name for name in {sorted(others)!r} if sys.modules[name]])'
    )
    done = subprocess.run(
        [sys.executable, '-c', program], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.stdout.strip() == '[]', done.stderr
