"""Compiling torch functions for this processor, with its C++ compiler, or for its GPU.

What was built is kept and found again by the next run, in `cache_folder()`. This module imports
torch only when something is compiled, so that `codetr doctor` can ask what is missing.
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
    """Nothing can be compiled here: says why, what to install and how to do without."""


def cache_folder() -> Path:
    """Where compiled functions are kept: where torch's variable says, else in the user's cache."""
    said = os.environ.get(_CACHE)
    if said:
        return Path(said)
    caches = os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache'
    return Path(caches, 'codetr_ros', 'torch')


def command() -> str:
    """The C++ compiler that torch calls."""
    return os.environ.get('CXX') or ('clang++' if sys.platform == 'darwin' else 'g++')


def missing() -> str:
    """What is needed to compile and is not here; empty if everything is."""
    if shutil.which(command()) is None:
        said = ' (environment variable CXX)' if os.environ.get('CXX') else ''
        return f'there is no C++ compiler {command()!r}{said}'
    header = Path(sysconfig.get_path('include'), 'Python.h')
    if not header.is_file():
        return f'the header {header} is missing'
    return ''


def compiled(function: _Function, example: Sequence[Any], without: str) -> _Function:
    """The same function, compiled for arguments of the shapes of an example.

    Args:
        function: of tensors, without branches that depend on their values.
        example: its arguments; it is called with them.
        without: the setting that makes do without compiling, and its value: for the error.

    Raises:
        CompilationError: a compiler or a header is missing, the compiler failed, or there is no
            place to keep what was compiled.
    """
    lacking = missing()
    if lacking:
        raise CompilationError(f'{lacking}: {REMEDY}, or set {without}')
    _make_cache(without)
    os.environ.setdefault(_CACHE, str(cache_folder()))
    import torch
    from torch._dynamo.exc import TorchDynamoException

    options: dict[str, Any] = {
        'fullgraph': True,
        'dynamic': False,
        # For a CPU one C++ file for all, the calls of matrix products included: it is built sooner
        # than a file for each kernel, and Python has nothing left to do between them.
        'options': {'cpp_wrapper': example[0].device.type == 'cpu'},
    }
    # As often as there are learners in this process. A GPU machine may bring its own torch: an
    # older one (2.11) has no such option, and compiles for as many as its recompile limit allows.
    if 'isolate_recompiles' in inspect.signature(torch.compile).parameters:
        options['isolate_recompiles'] = True
    result = cast(_Function, torch.compile(function, **options))
    try:
        with warnings.catch_warnings():
            # whoever wants fewer digits than float32 has chooses a precision in the settings
            warnings.filterwarnings('ignore', message='TensorFloat32 tensor cores')
            result(*example)
    except TorchDynamoException as error:
        said = str(error).split('Set TORCHDYNAMO_VERBOSE')[0].strip()
        device = example[0].device.type
        remedy = REMEDY if device == 'cpu' else f'see below what it needs for device={device}'
        raise CompilationError(
            f'torch could not compile {function.__qualname__}: {remedy}, or set {without}. '
            f'It said: {said[-2000:]}'
        ) from error
    return result


def _make_cache(without: str) -> None:
    """Make the folder for what is compiled, and see whether it can be written to."""
    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise CompilationError(
            f'what is compiled cannot be kept in {folder} ({error.strerror}): set the environment '
            f'variable {_CACHE} to a folder that can be written to, or set {without}'
        ) from None
