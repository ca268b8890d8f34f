"""Modules that users name: those that register a task of their own."""

import importlib
import os
import sys
import sysconfig
from pathlib import Path
from types import ModuleType

from codetr_ros.system.versions import version_of


def of_task(name: str) -> str | None:
    """The module of a task `module:id`, as Gymnasium writes it; None where there is none."""
    module, colon, _ = name.partition(':')
    return module if colon else None


def load(module: str) -> ModuleType:
    """Import a module by its name.

    It may lie in the current folder too, where `python` would look, but neither an installed
    command nor a node does.

    Raises:
        Exception: whatever its code raises; ModuleNotFoundError if there is none of that name.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        here = str(Path.cwd())
        if error.name != module.partition('.')[0] or here in sys.path:
            raise
    sys.path.append(here)
    return importlib.import_module(module)


def file_of_task(name: str) -> str | None:
    """The file of the module of a task `module:id`; None if it was not imported, or has none."""
    module = of_task(name)
    path = None if module is None else getattr(sys.modules.get(module), '__file__', None)
    return None if path is None else str(Path(path).resolve())


def version_of_task(name: str) -> dict[str, str | None]:
    """The version of the package of a task `module:id`, by its name: None if it is not installed;
    empty for other tasks.
    """
    package = (of_task(name) or '').partition('.')[0]
    return {package: version_of(package, package.replace('_', '-'))} if package else {}


def search_path(module: str, before: str) -> str:
    """PYTHONPATH for a process that is to import the same module as this one.

    Args:
        module: the module, imported here.
        before: PYTHONPATH until now.

    Returns:
        The same, with the folder that holds the module's package at its end, unless every
        interpreter looks there.
    """
    top = sys.modules.get(module.partition('.')[0])
    places = list(getattr(top, '__path__', [])) or [getattr(top, '__file__', None)]
    if places[0] is None:
        return before
    folder = str(Path(places[0]).resolve().parent)
    known = [*before.split(os.pathsep), *sysconfig.get_paths().values()]
    return before if folder in known else os.pathsep.join(filter(None, (before, folder)))
