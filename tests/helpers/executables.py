"""Executables that do nothing, where the launcher looks for them."""

from pathlib import Path

from codetr_ros.processes import launcher


def prefix(path: Path) -> Path:
    """A prefix with all node executables, which do nothing."""
    for package, name in launcher.EXECUTABLES.values():
        file = path / 'lib' / package / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text('')
        file.chmod(0o755)
    return path
