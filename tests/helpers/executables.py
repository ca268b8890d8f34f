"""Executables that do nothing, where the launcher looks for them."""

from pathlib import Path

from codetr_ros.records.roles import TABLE


def prefix(path: Path) -> Path:
    """A prefix with all node executables, which do nothing."""
    for role in TABLE.values():
        file = path / 'lib' / role.package / role.executable
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text('')
        file.chmod(0o755)
    return path
