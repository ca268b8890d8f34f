"""What the installed command refuses, as a shell sees it: a message, exit code 2, and nothing
else.
"""

import os
import subprocess

import pytest

from helpers.runs import CODETR, DEADLINE

REFUSED = {
    'an unknown task': (
        ['--task', 'Hoper-v5'],
        "there is no task 'Hoper-v5'",
    ),
    'a delay of 0': (
        ['--delay', '0'],
        'delay = 0: a segment has 1 to 100000 steps',
    ),
    'a delay beyond the horizon': (
        ['--task', 'Reacher-v5', '--delay', '51'],
        'delay = 51: task',
    ),
    'negative steps': (
        ['--steps', '-5'],
        'steps = -5: Input should be greater than or equal to 1',
    ),
    'the oracle as nodes': (
        ['--method', 'true'],
        'it runs in process only. Add --in-process, or choose another --method',
    ),
    'a folder that holds something': (
        ['--out', 'full'],
        'output folder full exists and is not empty (thesis.tex): choose another with --out, or '
        'remove it',
    ),
    'a file instead of a folder': (
        ['--out', 'full/thesis.tex'],
        'output folder full/thesis.tex is a file: choose another with --out',
    ),
    'a folder within a file': (
        ['--out', 'full/thesis.tex/run'],
        'output folder full/thesis.tex/run cannot be made',
    ),
    'a folder where none can be made': (  # by root neither
        ['--out', '/proc/run'],
        'output folder /proc/run cannot be made',
    ),
}


@pytest.fixture(scope='module')
def refusals(tmp_path_factory):
    """All at once: exit code, output, complaint and the folder where it was tried."""
    tried = {}
    for case, (arguments, _) in REFUSED.items():
        place = tmp_path_factory.mktemp('place')
        (place / 'full').mkdir()
        (place / 'full' / 'thesis.tex').write_text('years of work')
        started = subprocess.Popen(
            [str(CODETR), 'train', *arguments],
            cwd=place,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | {'COLUMNS': '300'},
        )
        tried[case] = started, place
    ended = {}
    for case, (started, place) in tried.items():
        out, complaint = started.communicate(timeout=DEADLINE)
        ended[case] = started.returncode, out, complaint, place
    return ended


@pytest.mark.parametrize('case', REFUSED)
def test_is_refused_in_one_message_with_exit_code_2_and_nothing_left_behind(refusals, case):
    code, out, complaint, place = refusals[case]
    assert REFUSED[case][1] in complaint
    assert complaint.startswith('codetr: ')
    assert 'Traceback' not in complaint
    assert (code, out) == (2, '')
    left = sorted(path.relative_to(place).as_posix() for path in place.rglob('*'))
    assert left == ['full', 'full/thesis.tex']
    assert (place / 'full' / 'thesis.tex').read_text() == 'years of work'
