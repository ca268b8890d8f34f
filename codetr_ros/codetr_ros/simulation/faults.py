"""What is wrong with code that is not ours, in words."""

import sysconfig
import traceback
from pathlib import Path
from typing import Any

FAULTS = (Exception, SystemExit)
"""Errors that somebody's code may raise: a program that ends itself is one of them."""

_INSTALLED = {'site-packages', 'dist-packages'}
_OURS = str(Path(__file__).parents[1])
_STANDARD = tuple({sysconfig.get_paths()[name] for name in ('stdlib', 'platstdlib')})


def in_words(error: BaseException) -> str:
    """An error of somebody's code, and the place there that raised it.

    The place is the innermost line that is no installed library's, for that is where the error
    can be mended; else the innermost line of a library.
    """
    places = [f for f in traceback.extract_tb(error.__traceback__) if _somebodys(f.filename)]
    own = [frame for frame in places if not _INSTALLED & set(Path(frame.filename).parts)]
    at = (own or places)[-1:]
    place = ''.join(f' ({Path(f.filename).name}, line {f.lineno}, in {f.name})' for f in at)
    return f'{type(error).__name__}: {error}{place}'


def _somebodys(path: str) -> bool:
    """Whether a file is neither ours nor of Python or of what makes environments."""
    installed = bool(_INSTALLED & set(Path(path).parts))
    return not (
        path.startswith((_OURS, '<frozen'))
        or (path.startswith(_STANDARD) and not installed)
        or path.endswith('gymnasium/envs/registration.py')
    )


def described(answer: Any) -> str:
    """An answer of somebody's code, for errors: its type, and its size or value."""
    if isinstance(answer, tuple):
        return f'{len(answer)} values'
    shape = getattr(answer, 'shape', None)
    if shape is not None:
        return f'{type(answer).__name__} of shape {tuple(shape)}'
    return f'{answer!r}' if answer is None else f'{type(answer).__name__} {repr(answer)[:60]}'
