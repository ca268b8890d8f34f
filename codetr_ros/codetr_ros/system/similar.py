"""The name that was probably meant by one that does not exist."""

import difflib
from collections.abc import Iterable, Mapping


def did_you_mean(given: str, known: Iterable[str]) -> str:
    """The known names that are close to a name, as a remark in brackets; empty if none is.

    Names are compared without regard to case, `-` and `_`. A dotted name matches by its last part
    too, if no whole name is close: `layers` is close to `codetr.layers`.
    """
    names = list(known)
    meant = _close(given, {_plain(name): [name] for name in names})
    if not meant:
        by_last: dict[str, list[str]] = {}
        for name in names:
            by_last.setdefault(_plain(name.rsplit('.', 1)[-1]), []).append(name)
        meant = _close(given, by_last)
    return f' (did you mean {" or ".join(meant)}?)' if meant else ''


def _close(given: str, names: Mapping[str, list[str]]) -> list[str]:
    forms = difflib.get_close_matches(_plain(given), names, n=3, cutoff=0.7)
    return [name for form in forms for name in names[form]][:3]


def _plain(name: str) -> str:
    return name.lower().replace('-', '_')
