"""What is served beside a run: its address is printed, whatever else its process prints."""

import sys
import time

from codetr_ros.cli.beside import Beside
from codetr_ros.runs import folder as run_folder

PATIENCE = 120.0


def printed(folder, program):
    """What is logged of a program beside a run, until something is."""
    (folder / run_folder.LOGS).mkdir()
    lines = []
    end = time.monotonic() + PATIENCE
    with Beside(folder, lines.append, 'page.log', (sys.executable, '-uc', program)) as beside:
        while not lines and time.monotonic() < end:
            beside.tick()
    return lines


def test_lines_of_the_middleware_are_not_taken_for_the_address(tmp_path):
    program = 'print("an error of a transport"); print("score as ann at http://x/"); '
    program += 'import signal; signal.pause()'
    assert printed(tmp_path, program) == ['score as ann at http://x/']


def test_a_program_that_ends_without_an_address_is_named_with_its_log(tmp_path):
    (line,) = printed(tmp_path, 'print("an error"); raise SystemExit(3)')
    assert line == (
        f'there is no page: its server ended with 3, {tmp_path / run_folder.LOGS / "page.log"}'
    )
