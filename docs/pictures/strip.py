"""Take the film strip of `codetr demo person`: a real run, its two pages in a headless Chromium.

    .venv/bin/python docs/pictures/strip.py [--steps N]

A person scores on the page beside the simulated one, and corrects a score. What the browser shows
at four moments becomes people.png.
"""

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

PICTURE = Path(__file__).resolve().parent / 'people.png'
NARROW, HEIGHT, PATIENCE = 400, 860, 180.0
ADDRESS = re.compile(r'(score as you|watch \S+) at (http\S+)')
STRIP = """<!doctype html><style>
body {{ margin: 0; padding: 12px; width: 1400px; font: 16px sans-serif; background: #fff; }}
main {{ display: grid; grid-template-columns: repeat({count}, 1fr); gap: 12px; }}
figure {{ margin: 0; }} img {{ width: 100%; border: 1px solid #999; }}
figcaption {{ margin-bottom: 6px; }}
</style><main>{figures}</main>"""


def addresses(process: Any, log: list[str]) -> dict[str, str]:
    """Where the pages of the demo are, by the first word of their lines.

    Raises:
        SystemExit: the demo has ended before.
    """
    found: dict[str, str] = {}
    for line in process.stdout:
        log.append(line)
        if match := ADDRESS.search(line):
            found[match[1].split()[0]] = match[2]
        if len(found) == 2:
            return found
    raise SystemExit('strip.py: the demo has no pages:\n' + ''.join(log))


def moments(context: Any, pages: dict[str, str]) -> Iterator[tuple[str, Any]]:
    """The tab at each moment of the strip, with what it shows."""
    score = context.new_page()
    score.set_default_timeout(PATIENCE * 1000)
    score.goto(pages['score'])
    score.get_by_alt_text('the robot').wait_for()
    yield 'The segment that is worth most', score
    score.get_by_role('button', name='2', exact=True).click()
    score.get_by_role('button', name='Correct').first.click()
    score.get_by_role('button', name='4', exact=True).click()
    score.get_by_text('Number 1: 4').wait_for()
    score.get_by_role('cell', name=re.compile('^phase')).first.wait_for()
    score.locator('#h-given').scroll_into_view_if_needed()
    yield 'Scored, corrected, learnt from', score
    watch = context.new_page()
    watch.set_default_timeout(PATIENCE * 1000)
    watch.goto(pages['watch'])
    watch.locator('#rewards canvas').first.wait_for()
    yield 'The run meanwhile', watch
    watch.get_by_text('inferred').first.scroll_into_view_if_needed()
    watch.locator('#rewards').scroll_into_view_if_needed()
    yield 'Inferred rewards, beside true ones', watch


def main() -> None:
    """Make the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--steps', type=int, default=12_000)
    steps = parser.parse_args().steps
    from playwright.sync_api import sync_playwright

    codetr = str(Path(sys.executable).with_name('codetr'))
    with tempfile.TemporaryDirectory() as place, sync_playwright() as playwright:
        folder = Path(place)
        command = [codetr, 'demo', 'person', '--no-open', '--steps', str(steps)]
        process = subprocess.Popen(
            [*command, '--out', str(folder / 'run')], stdout=subprocess.PIPE, text=True
        )
        log: list[str] = []
        pages = addresses(process, log)
        browser = playwright.chromium.launch(
            executable_path=shutil.which('chromium'), args=['--headless', '--no-sandbox']
        )
        view = {'width': NARROW, 'height': HEIGHT}
        context = browser.new_context(viewport=view, reduced_motion='reduce')
        figures = []
        for number, (text, tab) in enumerate(moments(context, pages)):
            tab.screenshot(path=folder / f'{number}.png')
            figures.append(
                f'<figure><figcaption>{number + 1}. {text}</figcaption>'
                f'<img src="{number}.png"></figure>'
            )
        (folder / 'strip.html').write_text(
            STRIP.format(count=len(figures), figures=''.join(figures))
        )
        strip = browser.new_page(viewport={'width': 1424, 'height': 100})
        strip.goto((folder / 'strip.html').as_uri())
        strip.screenshot(path=PICTURE, full_page=True)
        browser.close()
        log += process.stdout or ()
        if process.wait():
            raise SystemExit('strip.py: the demo failed:\n' + ''.join(log))


if __name__ == '__main__':
    main()
