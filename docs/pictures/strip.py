"""Take the film strip of `codetr demo person`: a real run, and its pages in a browser."""

import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

STEPS = 20_000
"""More than the demo has: a busy machine takes long to draw."""
WIDTH, HEIGHT, GAP = 380, 680, 12  # of each picture, and between two [pixels of a page]
SHARP = 2  # pixels of the strip for each of these
PATIENCE = 180.0  # [s]
ADDRESS = re.compile(r'(score as you|watch \S+) at (http\S+)')
LEARNT = re.compile('^(8|9|1[0-9]|20) of')
"""Phases after which what is inferred is shown."""
STRIP = """<!doctype html><style>
body {{ margin: 0; padding: 4px; font: 600 19px sans-serif; background: #fff; color: #111; }}
main {{ display: grid; grid-template-columns: repeat({count}, {width}px); gap: {gap}px; }}
figure {{ margin: 0; }} img {{ width: 100%; box-sizing: border-box; border: 1px solid #999; }}
figcaption {{ margin-bottom: 6px; white-space: nowrap; }}
</style><main>{figures}</main>"""


def addresses(process: Any, log: list[str]) -> dict[str, str]:
    """Where the two pages of the demo are: `score` and `watch`.

    Args:
        process: the demo.
        log: takes the lines that it has printed.

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


def opened(context: Any, url: str) -> Any:
    """A tab with a page."""
    tab = context.new_page()
    tab.set_default_timeout(PATIENCE * 1000)
    tab.goto(url)
    return tab


def moments(context: Any, pages: dict[str, str]) -> Iterator[tuple[str, Any]]:
    """The tab at each moment of the strip, with what it shows."""
    score, watch = opened(context, pages['score']), opened(context, pages['watch'])
    watch.locator('#returns canvas').first.wait_for()
    yield 'The run begins', watch
    score.get_by_alt_text('the robot').first.wait_for()
    yield 'A segment to score', score
    score.get_by_role('button', name='2', exact=True).click()
    score.get_by_text('Number 0: 2').wait_for()
    score.get_by_role('button', name='Correct').first.click()
    score.get_by_text('Corrected:').wait_for()
    score.get_by_role('button', name='4', exact=True).click()
    score.get_by_text('Number 1: 4').wait_for()
    score.get_by_role('cell', name=re.compile('^phase')).first.wait_for()
    at_top(score, '#points')
    yield 'Scored, corrected, learnt', score
    # by then the rewards are those of more than a few scores
    watch.locator('#facts dd', has_text=LEARNT).first.wait_for()
    watch.locator('#rewards .u-legend', has_text='right axis').wait_for()
    at_top(watch, '#h-episode')
    yield 'Rewards, inferred and true', watch


def at_top(tab: Any, selector: str) -> None:
    """Scroll until an element is the first that is seen."""
    tab.locator(selector).evaluate('element => element.scrollIntoView()')


def take(picture: Path, codetr: str) -> None:
    """Make the strip.

    Args:
        picture: the PNG that it becomes.
        codetr: the program.

    Raises:
        SystemExit: the demo failed.
    """
    from playwright.sync_api import sync_playwright

    with tempfile.TemporaryDirectory() as place, sync_playwright() as playwright:
        folder = Path(place)
        words = [codetr, 'demo', 'person', '--no-open', '--steps', str(STEPS)]
        process = subprocess.Popen(
            [*words, '--out', str(folder / 'arm')], stdout=subprocess.PIPE, text=True
        )
        log: list[str] = []
        try:
            pages = addresses(process, log)
            browser = playwright.chromium.launch(
                executable_path=shutil.which('chromium'), args=['--headless', '--no-sandbox']
            )
            compose(browser, picture, folder, pages)
            browser.close()
        finally:
            process.terminate()
            log += process.stdout or ()
            process.wait()


def compose(browser: Any, picture: Path, folder: Path, pages: dict[str, str]) -> None:
    """Photograph the moments, side by side."""
    view = {'width': WIDTH, 'height': HEIGHT}
    context = browser.new_context(
        viewport=view, device_scale_factor=SHARP, reduced_motion='reduce'
    )
    figures = []
    for number, (text, tab) in enumerate(moments(context, pages)):
        tab.screenshot(path=folder / f'{number}.png')
        figures.append(
            f'<figure><figcaption>{number + 1}. {text}</figcaption>'
            f'<img src="{number}.png"></figure>'
        )
    count = len(figures)
    page = folder / 'strip.html'
    page.write_text(STRIP.format(count=count, width=WIDTH, gap=GAP, figures=''.join(figures)))
    width = count * (WIDTH + GAP) - GAP + 8
    strip = browser.new_page(viewport={'width': width, 'height': 100}, device_scale_factor=1.25)
    strip.goto(page.as_uri())
    strip.screenshot(path=picture, full_page=True)
