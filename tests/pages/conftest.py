"""A real browser for the pages. It reaches the server of the test and nothing else."""

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

CHROMIUM = Path('/usr/bin/chromium')
FLAGS = (
    *('--headless', '--no-sandbox', '--disable-gpu', '--disable-quic', '--no-first-run'),
    *('--disable-background-networking', '--disable-component-update', '--disable-sync'),
)
NARROW, WIDE = 400, 1200
PATIENCE = 120_000  # [ms]
GONE = re.compile(
    r'net::ERR_(CONNECTION_(REFUSED|RESET|CLOSED)|EMPTY_RESPONSE|INCOMPLETE_CHUNKED_ENCODING)'
)
"""What a tab says of a server that has ended, or that ends while it asks for something."""


@pytest.fixture(scope='package')
def browser() -> Iterator[Any]:
    """Chromium, started once for all pages."""
    if not CHROMIUM.is_file():
        pytest.skip(f'there is no Chromium at {CHROMIUM}')
    sync_api = pytest.importorskip('playwright.sync_api')
    with sync_api.sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield started
        started.close()


@pytest.fixture
def tab(browser: Any) -> Iterator[Callable[..., Any]]:
    """Opens an address in a tab of its own: `tab(url, width=NARROW)`.

    At the end, no tab has asked another host for anything, nor has its console an error, unless
    the test has taken these from the lists `elsewhere` and `errors` of the tab.
    """
    opened = []

    def open_tab(url: str, width: int = WIDE, **more: Any) -> Any:
        context = browser.new_context(viewport={'width': width, 'height': 900}, **more)
        page = context.new_page()
        page.set_default_timeout(PATIENCE)
        page.elsewhere, page.errors = [], []
        own = urlsplit(url).netloc

        def through(route: Any) -> None:
            if urlsplit(route.request.url).netloc == own:
                route.continue_()
                return
            page.elsewhere.append(route.request.url)
            route.abort()

        def heard(message: Any) -> None:
            # a server may end before the tab, which then asks for it again
            if message.type == 'error' and not GONE.search(message.text):
                page.errors.append(message.text)

        page.route(lambda address: urlsplit(address).scheme not in ('data', 'blob'), through)
        page.on('console', heard)
        page.on('pageerror', lambda error: page.errors.append(str(error)))
        page.goto(url)
        opened.append((context, page))
        return page

    yield open_tab
    for context, _ in opened:
        context.close()
    for _, page in opened:
        assert page.elsewhere == []
        assert page.errors == []
