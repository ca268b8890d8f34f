"""How an example begins a run of its own."""

import secrets
import time
from pathlib import Path

from codetr_ros import config
from codetr_ros.config import Settings
from codetr_ros.processes import launcher
from codetr_ros.runs import folder as run_folder


def begin(name: str, settings: Settings, out: str | None) -> tuple[Settings, str, Path]:
    """The run of an example: its settings, its id, and its folder, which is made.

    Args:
        name: of the example.
        settings: of the run.
        out: its folder, which is new; None: one in runs/.

    Raises:
        SettingsError: a setting cannot be used.
        LaunchError: an executable is missing.
        RunFolderError: the folder is in use.
    """
    settings = config.settled(settings)
    for role in settings.roles:
        launcher.executable(role)
    stamp = time.strftime('%Y%m%d-%H%M%S')
    if out is None:
        folder = run_folder.create_next(Path(f'runs/{name}-{settings.seed}-{stamp}'))
    else:
        folder = run_folder.create(Path(out))
    return settings, f'r{stamp.replace("-", "_")}_{secrets.token_hex(2)}', folder
