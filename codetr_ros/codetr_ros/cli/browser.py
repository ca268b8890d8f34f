"""Opens pages in the browser of whoever sits at this machine."""

import os
import sys
import webbrowser

from codetr_ros.cli.terminal import console

SCREENS = ('DISPLAY', 'WAYLAND_DISPLAY', 'BROWSER')
"""Variables one of which is set where a browser can show itself, or is named."""


def show(text: str, url: str, open_it: bool) -> None:
    """Print where a page is served, and open it if that is wanted.

    Args:
        text: the line for people, with the address.
        url: the address.
        open_it: whether to open it; where there is no browser, that is printed.
    """
    console().print(text)
    if not open_it:
        return
    # without a screen, a browser for terminals would take this one
    screen = sys.platform == 'darwin' or any(os.environ.get(name) for name in SCREENS)
    if not (screen and webbrowser.open(url)):
        console(stderr=True).print('codetr: no browser was found here: open the address yourself')
