"""The check of a GPU machine: whatever happens to one step, the others' results are kept."""

import importlib
import os
import select
import time
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / 'benchmarks'


@pytest.fixture
def gpu_check(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module('gpu_check')


def step(gpu_check, name: str, code: str, limit: float = 60.0):
    return gpu_check.Step(name, ['-c', code], limit, f'{name}.md')


def writes(path: Path) -> str:
    return f'from pathlib import Path; Path({str(path)!r}).write_text("numbers")'


def has_ended(process: int, seconds: float) -> bool:
    try:
        handle = os.pidfd_open(process)
    except ProcessLookupError:
        return True
    with os.fdopen(handle):
        return bool(select.select([handle], [], [], seconds)[0])


@pytest.mark.slow
def test_a_step_that_fails_or_hangs_costs_the_others_nothing(gpu_check, tmp_path):
    """What a step had started ends with it."""
    child = tmp_path / 'child'
    hanging = f"""
import subprocess, sys, time
from pathlib import Path
sleeps = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(300)'])
Path({str(child)!r}).write_text(str(sleeps.pid))
time.sleep(300)
"""
    planned = [
        step(gpu_check, 'fails', 'raise SystemExit("no kernel image")'),
        step(gpu_check, 'hangs', hanging, limit=6),
        step(gpu_check, 'works', writes(tmp_path / 'works.md')),
    ]
    began = time.monotonic()
    outcomes = gpu_check.check(planned, 120, {'GPU': 'made up'}, tmp_path)
    assert time.monotonic() - began < 100
    assert [outcome.done for outcome in outcomes] == [False, False, True]
    assert 'no kernel image' in (tmp_path / 'logs' / 'fails.log').read_text()
    table = (tmp_path / 'check.md').read_text()
    for line in (
        '- GPU: made up',
        '| fails | failed with exit code 1, see its log |',
        '| hangs | cut off after 6 s |',
        '[works.md](works.md)',
    ):
        assert line in table
    assert has_ended(int(child.read_text()), 20)


def test_what_is_there_is_written_before_the_next_step_begins(gpu_check, tmp_path):
    table = tmp_path / 'check.md'
    reads = f'import sys; sys.exit("| first | done |" not in open({str(table)!r}).read())'
    planned = [step(gpu_check, 'first', 'pass'), step(gpu_check, 'second', reads)]
    outcomes = gpu_check.check(planned, 120, {}, tmp_path)
    assert [outcome.ending for outcome in outcomes] == ['done', 'done']


def test_no_step_is_begun_for_which_no_time_is_left(gpu_check, tmp_path):
    late = tmp_path / 'late'
    outcomes = gpu_check.check([step(gpu_check, 'late', writes(late))], 4, {}, tmp_path)
    assert outcomes[0].ending == 'left out: 4 s were left' and not late.exists()


REPORT = """<testsuites><testsuite>
<testcase classname="tests.test_a" name="test_one" time="0.5"/>
<testcase classname="tests.test_a" name="test_two" time="1.0">
<failure message="TypeError: compile() got&#10;more">trace</failure></testcase>
<testcase classname="tests.test_a" name="test_three" time="0"><skipped message="a GPU"/></testcase>
</testsuite></testsuites>"""


def test_tests_are_counted_and_those_that_did_not_pass_are_named_with_the_reason(
    gpu_check, tmp_path
):
    code = (
        'from pathlib import Path; '
        f'Path({str(tmp_path / "logs" / "tests.xml")!r}).write_text({REPORT!r})'
    )
    gpu_check.check([step(gpu_check, 'tests', code)], 120, {}, tmp_path)
    table = (tmp_path / 'check.md').read_text()
    assert 'Tests: 1 passed, 1 failure, 1 skipped.' in table
    assert '- failure: `test_two`: TypeError: compile() got\n' in table
    rows = (tmp_path / 'tests.csv').read_text().splitlines()
    assert rows[1] == 'tests.test_a,test_one,passed,0.5,'


def test_each_step_asks_for_a_script_that_is_there_and_for_the_device_that_is_checked(
    gpu_check, tmp_path
):
    for smallest in (False, True):
        for each in gpu_check.steps('cuda:1', smallest, tmp_path):
            if each.name == 'tests':
                assert all(Path(path).is_file() for path in each.command if '.py' in path)
                continue
            assert 'cuda:1' in each.command
            first = each.command[0]
            assert first == '-m' or (BENCHMARKS / first).is_file()
