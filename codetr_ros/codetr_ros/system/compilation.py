"""Compiling torch functions for this processor, with its C++ compiler, or for its GPU.

The results are kept in `cache_folder()` for the next run. This module imports torch only to
compile, so that `codetr doctor` can ask quickly what is missing.
"""

import inspect
import os
import shutil
import sys
import sysconfig
import tempfile
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar, cast

REMEDY = 'install a C++ compiler and Python headers (Debian, Ubuntu: apt install g++ python3-dev)'
_CACHE = 'TORCHINDUCTOR_CACHE_DIR'
_Function = TypeVar('_Function', bound=Callable[..., object])


class CompilationError(RuntimeError):
    """Nothing can be compiled here: names the reason, what to install and how to do without."""


def cache_folder() -> Path:
    """The folder of compiled functions: the one in torch's variable, else in the user's cache."""
    chosen = os.environ.get(_CACHE)
    if chosen:
        return Path(chosen)
    caches = os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache'
    return Path(caches, 'codetr_ros', 'torch')


def command() -> str:
    """The C++ compiler that torch calls."""
    return os.environ.get('CXX') or ('clang++' if sys.platform == 'darwin' else 'g++')


def missing() -> str:
    """What is needed to compile and is missing; empty if nothing is."""
    if shutil.which(command()) is None:
        source = ' (environment variable CXX)' if os.environ.get('CXX') else ''
        return f'there is no C++ compiler {command()!r}{source}'
    header = Path(sysconfig.get_path('include'), 'Python.h')
    if not header.is_file():
        return f'the header {header} is missing'
    return ''


def check(without: str) -> None:
    """Check that something can be compiled here, as far as that is known beforehand.

    Args:
        without: the setting, with its value, that avoids compiling: for the error.

    Raises:
        CompilationError: a compiler or a header is missing.
    """
    lacking = missing()
    if lacking:
        raise CompilationError(f'{lacking}: {REMEDY}, or set {without}')


def compiled(function: _Function, example: Sequence[Any], without: str) -> _Function:
    """The same function, compiled for arguments of the shapes of an example.

    Args:
        function: of tensors, without branches that depend on their values.
        example: its arguments; it is called with them.
        without: the setting, with its value, that avoids compiling: for the error.

    Raises:
        CompilationError: a compiler or a header is missing, the compiler failed, or the result
            cannot be kept.
    """
    check(without)
    _make_cache(without)
    os.environ.setdefault(_CACHE, str(cache_folder()))
    import torch
    from torch._dynamo.exc import TorchDynamoException

    options: dict[str, Any] = {
        'fullgraph': True,
        'dynamic': False,
        # On a CPU one C++ file for all, calls of matrix products included: it builds faster than
        # a file for each kernel, and leaves Python nothing to do between kernels.
        'options': {'cpp_wrapper': example[0].device.type == 'cpu'},
    }
    # For any number of learners in this process. A GPU machine may bring its own torch: an older
    # one (2.11) lacks this option, and compiles for as many as its recompile limit allows.
    if 'isolate_recompiles' in inspect.signature(torch.compile).parameters:
        options['isolate_recompiles'] = True
    result = cast(_Function, torch.compile(function, **options))
    try:
        with warnings.catch_warnings():
            # fewer digits than those of float32 are chosen by a precision in the settings
            warnings.filterwarnings('ignore', message='TensorFloat32 tensor cores')
            result(*example)
    except TorchDynamoException as error:
        reason = str(error).split('Set TORCHDYNAMO_VERBOSE')[0].strip()
        device = example[0].device.type
        remedy = REMEDY if device == 'cpu' else f'see below what it needs for device={device}'
        raise CompilationError(
            f'torch could not compile {function.__qualname__}: {remedy}, or set {without}. '
            f'Its error: {reason[-2000:]}'
        ) from error
    return result


def _make_cache(without: str) -> None:
    """Make the folder for compiled functions, and check that it can be written to."""
    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise CompilationError(
            f'compiled functions cannot be kept in {folder} ({error.strerror}): set the '
            f'environment variable {_CACHE} to a folder that can be written to, or set {without}'
        ) from None
