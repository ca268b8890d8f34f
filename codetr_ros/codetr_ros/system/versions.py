"""Versions of the software and hardware that decide the numbers of a run."""

import platform
from importlib import metadata


def version_of(*distributions: str) -> str | None:
    """Version of the first of these distributions that is installed; nothing is imported."""
    for name in distributions:
        try:
            return metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return None


def versions() -> dict[str, str | None]:
    """Versions of the software and hardware that decide the numbers of a run."""
    return {
        'codetr_ros': version_of('codetr_ros'),
        'python': platform.python_version(),
        'numpy': version_of('numpy'),
        'torch': version_of('torch'),
        'mujoco': version_of('mujoco'),
        'gymnasium': version_of('gymnasium'),
        'dm_control': version_of('dm-control'),
        'rclpy': version_of('ros-jazzy-rclpy', 'rclpy'),
        'machine': platform.machine(),
        'system': platform.platform(),
    }
