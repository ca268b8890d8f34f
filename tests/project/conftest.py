from pathlib import Path

import pytest

import bootstrap


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A project folder with requirements and one message."""
    for name in (*bootstrap.REQUIREMENTS, bootstrap.WITHOUT_DEPENDENCIES):
        (tmp_path / name).write_text('numpy==2.2.6\n')
    (tmp_path / 'msgs' / 'msg').mkdir(parents=True)
    (tmp_path / 'msgs' / 'msg' / 'Step.msg').write_text('uint32 step\n')
    return tmp_path
