"""The browser is opened where there is one; where there is none, that is printed."""

import os
import subprocess
import sys

CODE = 'from codetr_ros.cli import browser; browser.show("look at it", "http://x/?t=1", {})'


def shown(open_it, **variables):
    """What a process prints that shows a page where only these variables name a screen."""
    bare = {k: v for k, v in os.environ.items() if k not in ('DISPLAY', 'WAYLAND_DISPLAY')}
    return subprocess.run(
        (sys.executable, '-c', CODE.format(open_it)),
        env=bare | variables,
        capture_output=True,
        text=True,
        check=True,
    )


def test_a_page_is_opened_only_if_that_is_wanted(tmp_path):
    opened = tmp_path / 'opened'
    program = tmp_path / 'browser'
    program.write_text(f'#!/bin/sh\nprintf %s "$1" > {opened}\n')
    program.chmod(0o755)
    done = shown(False, BROWSER=f'{program} %s')
    assert done.stdout == 'look at it\n' and not opened.exists()
    done = shown(True, BROWSER=f'{program} %s')
    assert done.stdout == 'look at it\n' and done.stderr == ''
    assert opened.read_text() == 'http://x/?t=1'


def test_without_a_screen_no_browser_takes_the_terminal():
    done = shown(True, BROWSER='')
    assert done.stdout == 'look at it\n'
    assert done.stderr == 'codetr: no browser was found here: open the address yourself\n'
