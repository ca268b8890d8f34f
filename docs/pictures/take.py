"""Take the pictures of what one sees: the terminal of the default run, its report, and its page,
and a film strip of `codetr demo person`.

    .venv/bin/python docs/pictures/take.py [--run-folder DIR] [--only-people]

The run is a real one, over topics, in a terminal of 92 columns. What it leaves on the screen
becomes terminal.svg. A headless Chromium photographs the report, and the page of `codetr watch`:
report.png and watch.png. strip.py lets a person score on the page of the demo: people.png.
"""

import argparse
import fcntl
import os
import pty
import re
import shutil
import struct
import subprocess
import sys
import tempfile
import termios
from pathlib import Path

import strip
from rich.console import Console
from rich.text import Text

HERE = Path(__file__).resolve().parent
COLUMNS, ROWS = 92, 50
MOVE = re.compile(r'\x1b\[(?:\?25[lh]|2K|1A)|\r|\n')


def recorded(command: list[str]) -> str:
    """All that a command writes to a terminal of its own.

    Raises:
        CalledProcessError: it failed.
    """
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack('HHHH', ROWS, COLUMNS, 0, 0))
    env = os.environ | {'TERM': 'xterm-256color', 'COLUMNS': str(COLUMNS), 'LINES': str(ROWS)}
    process = subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=theirs, env=env)
    os.close(theirs)
    parts = []
    while True:
        try:
            part = os.read(ours, 65536)
        except OSError:  # Linux' way to end a terminal that nobody writes to any more
            break
        if not part:
            break
        parts.append(part)
    os.close(ours)
    if code := process.wait():
        raise subprocess.CalledProcessError(code, command)
    return b''.join(parts).decode()


def screen(output: str) -> list[str]:
    """The lines that are on the screen in the end, colours included."""
    lines, row = [''], 0
    position = 0
    for move in [*MOVE.finditer(output), None]:
        text = output[position : move.start() if move else None]
        lines[row] += text
        if move is None:
            break
        position = move.end()
        if move[0] == '\n':
            row += 1
            if row == len(lines):
                lines.append('')
        elif move[0].endswith('1A'):
            row -= 1
        elif move[0].endswith('2K'):
            lines[row] = ''
    return lines


def drawn(lines: list[str], title: str) -> str:
    """The screen as SVG, in whatever monospaced font its reader has."""
    with Path(os.devnull).open('w') as nowhere:
        console = Console(record=True, width=COLUMNS, file=nowhere, force_terminal=True)
        for line in lines:
            console.print(Text.from_ansi(line.rstrip()), soft_wrap=True)
        svg = console.export_svg(title=title, unique_id='terminal')
    svg = re.sub(r'@font-face \{.*?\}', '', svg, flags=re.DOTALL)
    svg = svg.replace('font-family: Fira Code, monospace', 'font-family: monospace')
    return re.sub(r'\n\s*\n', '\n', svg)


def photographed(page: Path, picture: Path, size: str) -> None:
    """Photograph the top of a page with a headless Chromium."""
    browser = shutil.which('chromium') or shutil.which('google-chrome')
    if browser is None:
        raise SystemExit('take.py: there is no chromium: apt install chromium')
    with tempfile.TemporaryDirectory() as profile:
        flags = ['--headless', '--no-sandbox', '--disable-gpu', '--hide-scrollbars']
        flags += [f'--user-data-dir={profile}', f'--screenshot={picture}', f'--window-size={size}']
        subprocess.run([browser, *flags, page.as_uri()], check=True, capture_output=True)


def watched(folder: Path, picture: Path) -> None:
    """Photograph the page of `codetr watch`."""
    from playwright.sync_api import sync_playwright

    from codetr_ros.pages.feed import Feed
    from codetr_ros.pages.watching import RunSource, serve
    from codetr_ros.runs.folder import read_settings

    feed = Feed()
    source = RunSource(folder, read_settings(folder), feed)
    source.poll()
    with serve(source, feed) as server, sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which('chromium'), args=['--headless', '--no-sandbox']
        )
        tab = browser.new_page(viewport={'width': 1200, 'height': 900})
        tab.goto(server.url)
        tab.wait_for_selector('#rewards canvas')
        tab.wait_for_load_state('load')
        tab.screenshot(path=picture, full_page=True)
        browser.close()


def main() -> None:
    """Make the pictures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--run-folder', type=Path, default=Path('runs/pictures'))
    parser.add_argument('--only-people', action='store_true', help='only the film strip')
    given = parser.parse_args()
    codetr = str(Path(sys.executable).with_name('codetr'))
    strip.take(HERE / 'people.png', codetr)
    if given.only_people:
        return
    folder = given.run_folder
    output = recorded([codetr, 'train', '--out', str(folder)])
    (HERE / 'terminal.svg').write_text(drawn(screen(output), 'make train'))
    photographed(folder.resolve() / 'report.html', HERE / 'report.png', '1000,1460')
    watched(folder, HERE / 'watch.png')


if __name__ == '__main__':
    main()
