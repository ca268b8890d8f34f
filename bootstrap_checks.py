"""What the set-up needs of a machine, and what it says where that is missing."""

import os
import re
import shutil
import sys
import sysconfig
import tempfile
from pathlib import Path

OLDEST, NEWEST = (3, 10), (3, 13)
"""The Pythons for which ROS 2 Jazzy is to be had as wheels."""
SPACE_NEEDED = 4 * 10**9
"""Bytes: 2 GB of packages with the CPU build of torch, and room to unpack them."""
LONGEST_PATH = 100
"""Characters of the project's path: the kernel reads no more than 127 of a script's first line."""


class SetupError(Exception):
    """Something that the set-up needs is missing: the message names it and the remedy."""


def check_python(version, platform=sys.platform):
    """Refuse a Python or a system for which there are no ROS wheels."""
    if not OLDEST <= tuple(version[:2]) <= NEWEST:
        found = '.'.join(str(n) for n in version[:3])
        raise SetupError(
            f'this is Python {found} ({sys.executable}), but ROS 2 Jazzy comes as wheels for '
            'Python 3.10 to 3.13 only. Name one of those: make test PYTHON=python3.12'
        )
    if platform != 'linux':
        raise SetupError(
            f'this system is {platform!r}, but ROS 2 Jazzy comes as wheels for Linux only. '
            'Use a Linux machine or container.'
        )


def check_folder(root):
    """Refuse a folder in which nothing can be written, or whose path no script can name."""
    if re.search(r'\s', str(root)) or len(str(root)) > LONGEST_PATH:
        raise SetupError(
            f'the path of the project is {str(root)!r}. Commands start through it, so it must '
            f'hold no blanks and at most {LONGEST_PATH} characters. Move the project.'
        )
    try:
        with tempfile.TemporaryFile(dir=str(root)):
            pass
    except OSError as error:
        raise SetupError(
            f'cannot write into {root} ({error.strerror}). Copy the project to a folder of yours.'
        ) from None


def check_space(root, needed=SPACE_NEEDED):
    """Refuse to begin what would fill the disk."""
    free = shutil.disk_usage(str(root)).free
    if free < needed:
        raise SetupError(
            f'{root} has {free / 1e9:.1f} GB free, but the packages need {needed / 1e9:.0f} GB. '
            'Free some space or move the project to a larger disk.'
        )


def check_venv_module():
    """Refuse a Python that cannot make virtual environments (Debian ships it without)."""
    try:
        import ensurepip  # noqa: F401
        import venv  # noqa: F401
    except ImportError as error:
        version = f'{sys.version_info[0]}.{sys.version_info[1]}'
        raise SetupError(
            f'{sys.executable} has no module {error.name!r}, which makes virtual environments. '
            f'Install it (Debian, Ubuntu: apt install python{version}-venv).'
        ) from None


def check_compilers(search=None, include=None):
    """Refuse a machine without what builds the messages: compilers, make, Python's headers.

    Args:
        search: folders to search for commands, as in PATH; those of PATH where not given.
        include: folder that should hold Python.h; that of this Python where not given.
    """
    for variable, command, what in (
        ('CC', 'cc', 'C compiler'),
        ('CXX', 'c++', 'C++ compiler'),
        ('', 'make', 'make'),
    ):
        wanted = (os.environ.get(variable) or command).split()[0]
        if shutil.which(wanted, path=search) is None:
            raise SetupError(
                f'there is no {what} (looked for {wanted!r}). Install one '
                '(Debian, Ubuntu: apt install build-essential; Fedora: dnf install gcc-c++ make).'
            )
    folder = Path(include or sysconfig.get_config_var('INCLUDEPY'))
    if not (folder / 'Python.h').is_file():
        version = f'{sys.version_info[0]}.{sys.version_info[1]}'
        raise SetupError(
            f"there is no {folder / 'Python.h'}: Python's headers are missing, and the messages "
            'are compiled against them. Install them '
            f'(Debian, Ubuntu: apt install python{version}-dev; '
            'Fedora: dnf install python3-devel).'
        )


def machine_fault(output):
    """Say what of the machine stopped pip or uv, and the remedy; None where nothing of it did."""
    if is_full(output):
        return (
            'the disk is full: that of the project, of temporary files or of downloaded packages. '
            'Free some space, or put the last two elsewhere: '
            'TMPDIR=/path/on/a/larger/disk UV_CACHE_DIR=/path/on/a/larger/disk make test'
        )
    if re.search(
        r'NewConnectionError|NameResolutionError|ConnectTimeout|ReadTimeout|ProxyError|timed out'
        r'|name resolution|Name or service not known|Network is unreachable'
        r'|Connection (refused|reset|broken)',
        output,
    ):
        return (
            'the package index cannot be reached. Check the network, or tell pip of a proxy '
            'or of an index that can be (PIP_PROXY, PIP_INDEX_URL).'
        )
    if re.search(r'CERTIFICATE_VERIFY_FAILED|SSLError', output):
        return (
            'the package index shows a certificate that is not trusted here. '
            'Name the certificates to trust: PIP_CERT=/path/to/certificates.pem'
        )
    return None


def is_full(output):
    """Whether pip or uv stopped because a disk is full or a quota is used up."""
    return bool(re.search(r'No space left on device|Disk quota exceeded|Errno (28|122)\b', output))


def explain_pip(output):
    """Say why pip failed and what to do, from what it printed."""
    missing = re.search(r'No matching distribution found for (\S+)', output)
    return (
        machine_fault(output)
        or (missing and unknown_package(missing.group(1)))
        or 'pip failed. Its last lines are above.'
    )


def unknown_package(requirement):
    """Say that no index has what is required, and what to do."""
    return (
        f'the package index has no {requirement} for this Python and machine '
        f'({sysconfig.get_platform()}). The ROS wheels exist for x86-64 with glibc '
        '2.28 or newer; if that is what you have, check which index pip uses: '
        'python3 -m pip config list'
    )


def tail(output, lines=15):
    """The last lines of what a command printed."""
    return '\n'.join(output.rstrip().splitlines()[-lines:])


def say(message):
    """Print what happens now."""
    print(f'set-up: {message}', flush=True)
