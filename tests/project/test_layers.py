"""The order of the library's folders, as pyproject.toml states it, holds over every import."""

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LIBRARY = ROOT / 'codetr_ros' / 'codetr_ros'


def test_each_folder_imports_lower_ones_only_and_ros_stays_inside_its_folder():
    # in a process of its own: it configures logging for whatever runs after it
    program = 'import sys; from importlinter.cli import lint_imports_command as f; sys.exit(f())'
    ended = subprocess.run(
        [sys.executable, '-c', program, '--config', 'pyproject.toml', '--no-cache'],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr


def test_the_library_has_at_most_three_loose_modules():
    assert len(list(LIBRARY.glob('*.py'))) <= 3


def test_learning_imports_without_ros(tmp_path):
    program = (
        "import sys\nsys.modules['rclpy'] = sys.modules['codetr_msgs'] = None\n"
        'from codetr_ros.cores import in_process\n'
        'from codetr_ros.offline import fitting, labelling\n'
        'from codetr_ros.benchmark import report, run\n'
        'import codetr_ros.cli\n'
    )
    subprocess.run([sys.executable, '-c', program], check=True, cwd=tmp_path, timeout=120)


# what is read there was written by the same program a moment before, or belongs to the package
OWN_TEXTS = {
    'bags/info.py': 'of what json.dumps has just made',
    'bags/topics.py': 'of a file of this package',
    'runs/checkpoints.py': 'of what json.dumps has just made',
}


def test_yaml_and_json_from_outside_are_read_by_the_one_reader_with_limits():
    reads = re.compile(r'\byaml\.(safe_)?(load|parse|scan|compose)|\bjson\.loads?\(')
    found = {
        str(path.relative_to(LIBRARY))
        for path in LIBRARY.rglob('*.py')
        if reads.search(path.read_text())
    }
    assert found == {'system/parsing.py', *OWN_TEXTS}
