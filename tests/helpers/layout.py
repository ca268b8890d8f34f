"""The layout for Foxglove that is shipped."""

import json
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
NAMESPACE = '/codetr'
"""Of the nodes that it plots."""


def layout() -> dict[str, Any]:
    """The whole of it."""
    text = (ROOT / 'codetr_ros' / 'config' / 'foxglove.json').read_text()
    return json.loads(text)  # type: ignore[no-any-return]


def plotted() -> set[str]:
    """Topics that it plots."""
    found = set()
    for identity, panel in layout()['configById'].items():
        assert identity.startswith('Plot!')
        for path in panel['paths']:
            name, _, field = path['value'].partition('.')
            assert field == 'data'
            found.add(name)
    return found
