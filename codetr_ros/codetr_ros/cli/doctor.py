"""`codetr doctor`: check that everything a run needs is there, with a line for each check."""

import dataclasses
import importlib
import os
import platform
import re
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Literal

from codetr_ros.cli import rendering
from codetr_ros.records import PROTOCOL_VERSION, ROLES
from codetr_ros.system import compilation, processors
from codetr_ros.system.versions import version_of

if sys.platform != 'win32':
    import fcntl

SHARED_MEMORY = Path('/dev/shm')
_NEEDED_MB = 64  # free shared memory that the nodes of a run take, with room to spare
_INSTALL = (
    'run `make setup` in the project, or build the colcon workspace and source install/setup.bash'
)


@dataclasses.dataclass(frozen=True)
class Check:
    """The result of one check.

    Attributes:
        name: the thing that was checked.
        status: fail: nothing will work over topics; warn: something may not.
        detail: the version, place or value that was observed.
        remedy: what to do about it; empty where nothing has to be done.
    """

    name: str
    status: Literal['ok', 'warn', 'fail']
    detail: str
    remedy: str = ''


def python() -> Check:
    """Whether ROS 2 Jazzy exists for this version of Python."""
    detail = f'{platform.python_version()} ({sys.executable})'
    if not (3, 10) <= sys.version_info[:2] <= (3, 13):
        return Check('Python', 'fail', detail, 'use Python 3.10 to 3.13')
    return Check('Python', 'ok', detail)


def ros() -> Check:
    """Whether rclpy can be imported."""
    try:
        importlib.import_module('rclpy')
    except ImportError as error:
        return Check('ROS', 'fail', f'rclpy cannot be imported: {error}', _INSTALL)
    detail = f'rclpy {version_of("ros-jazzy-rclpy", "rclpy") or "of unknown version"}'
    distribution = os.environ.get('ROS_DISTRO', 'jazzy')
    if distribution != 'jazzy':
        return Check(
            'ROS',
            'warn',
            f'{detail}, ROS_DISTRO={distribution}',
            'this is tested with ROS 2 Jazzy',
        )
    return Check('ROS', 'ok', detail)


def middleware() -> Check:
    """The RMW that carries the topics."""
    try:
        utilities = importlib.import_module('rclpy.utilities')
        name = str(utilities.get_rmw_implementation_identifier())
    except Exception as error:  # noqa: BLE001  rclpy raises the errors of its C library
        return Check('RMW', 'fail', f'{type(error).__name__}: {error}', _INSTALL)
    if name != 'rmw_fastrtps_cpp':
        remedy = 'all measurements here are with rmw_fastrtps_cpp: unset RMW_IMPLEMENTATION'
        return Check('RMW', 'warn', f'{name}, not rmw_fastrtps_cpp', remedy)
    return Check('RMW', 'ok', name)


def messages() -> Check:
    """Whether the messages are built, and of this version."""
    try:
        module = importlib.import_module('codetr_msgs.msg')
        version = int(module.RunSpec.PROTOCOL_VERSION)
    except (ImportError, AttributeError) as error:
        return Check('codetr_msgs', 'fail', f'cannot be imported: {error}', _INSTALL)
    if version != PROTOCOL_VERSION:
        return Check(
            'codetr_msgs',
            'fail',
            f'protocol version {version}, the library has {PROTOCOL_VERSION}',
            f'built from other sources: {_INSTALL}',
        )
    return Check('codetr_msgs', 'ok', f'protocol version {version}')


def executables() -> Check:
    """Whether the nodes are built."""
    from codetr_ros.processes import launcher

    try:
        paths = [launcher.executable(role) for role in ROLES]
    except launcher.LaunchError as error:
        return Check('nodes', 'fail', str(error).split(':')[0], _INSTALL)
    return Check('nodes', 'ok', f'{len(paths)} executables in {paths[0].parents[1]}')


def discovery(environ: Mapping[str, str] = os.environ) -> Check:
    """How far nodes look for each other."""
    reach = environ.get('ROS_AUTOMATIC_DISCOVERY_RANGE')
    domain = environ.get('ROS_DOMAIN_ID', '0')
    detail = f'ROS_DOMAIN_ID={domain}, ROS_AUTOMATIC_DISCOVERY_RANGE={reach or "not set"}'
    if not re.fullmatch(r'\d+', domain) or int(domain) > 101:
        return Check('discovery', 'fail', detail, 'ROS_DOMAIN_ID must be a number from 0 to 101')
    if reach is None:
        return Check(
            'discovery', 'ok', f'{detail} (`codetr train` sets LOCALHOST: this host only)'
        )
    if reach not in ('LOCALHOST', 'SUBNET', 'OFF', 'SYSTEM_DEFAULT'):
        remedy = 'ROS_AUTOMATIC_DISCOVERY_RANGE must be LOCALHOST, SUBNET, OFF or SYSTEM_DEFAULT'
        return Check('discovery', 'fail', detail, remedy)
    if reach == 'OFF':
        remedy = 'nodes will not find each other: unset ROS_AUTOMATIC_DISCOVERY_RANGE'
        return Check('discovery', 'fail', detail, remedy)
    if reach != 'LOCALHOST':
        return Check('discovery', 'warn', detail, 'other hosts of the network can join the run')
    return Check('discovery', 'ok', detail)


def _in_use(lock: Path) -> bool:
    """Whether a process holds the lock file of a Fast DDS segment, as it does while it lives."""
    try:
        with lock.open('rb') as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:  # locked, just removed, or of another user: perhaps not dead
        return True
    return False


def leftovers(folder: Path = SHARED_MEMORY) -> Check:
    """Files that killed processes have left in shared memory."""
    files: list[Path] = []
    locks = [p for p in folder.glob('fastrtps_*') if p.name.endswith(('_el', '_sl'))]
    for lock in locks:
        if not _in_use(lock):
            files += [lock, lock.with_name(lock.name[:-3])]
    sizes = [p.stat().st_size for p in files if p.exists()]
    if not sizes:
        return Check('leftovers', 'ok', f'none of dead processes in {folder}')
    tool = Path(sys.prefix) / 'tools' / 'fastdds' / 'fastdds.py'
    command = f'{sys.executable} {tool} shm clean' if tool.is_file() else 'fastdds shm clean'
    detail = f'{len(sizes)} files of dead processes in {folder}, {sum(sizes) / 1e6:.1f} MB'
    return Check(
        'leftovers', 'warn', detail, f'harmless except for the memory; remove with: {command}'
    )


def shared_memory(folder: Path = SHARED_MEMORY) -> Check:
    """Room for the transport between processes."""
    try:
        free = shutil.disk_usage(folder).free / 1e6
    except OSError as error:
        remedy = f'mount a tmpfs on {folder}: without it messages go over UDP, more slowly'
        return Check('shared memory', 'warn', f'{folder}: {error.strerror}', remedy)
    if free < _NEEDED_MB:
        remedy = (
            f'{_NEEDED_MB} MB are needed: remove files, or enlarge it (docker run --shm-size=1g)'
        )
        return Check('shared memory', 'fail', f'{free:.0f} MB free in {folder}', remedy)
    return Check('shared memory', 'ok', f'{free:.0f} MB free in {folder}')


def torch() -> list[Check]:
    """torch, its threads, and a GPU."""
    try:
        module = importlib.import_module('torch')
    except ImportError as error:
        return [Check('torch', 'fail', f'cannot be imported: {error}', _INSTALL)]
    threads = os.environ.get('OMP_NUM_THREADS')
    variable = f', OMP_NUM_THREADS={threads}' if threads else ''
    threads_now, cores = module.get_num_threads(), processors.count()
    detail = f'{module.__version__}, {threads_now} threads on {cores} cores{variable}'
    checks = [Check('torch', 'ok', f'{detail} (`codetr train` sets its own: --threads)')]
    if module.cuda.is_available():
        name = module.cuda.get_device_name()
        checks.append(Check('GPU', 'ok', f'{name}: device=cuda, reward_device=cuda'))
    else:
        checks.append(Check('GPU', 'ok', 'none that torch can use; device=cpu needs none'))
    return checks


def compiler() -> Check:
    """The C++ compiler that `sac.compile` needs."""
    lacking = compilation.missing()
    if lacking:
        remedy = f'{compilation.REMEDY}; without, set sac.compile=false'
        return Check('C++ compiler', 'warn', lacking, remedy)
    detail = (
        f'{compilation.command()}, compiled functions are kept in {compilation.cache_folder()}'
    )
    return Check('C++ compiler', 'ok', detail)


def simulators() -> Check:
    """MuJoCo and the packages built on it."""
    versions = {name: version_of(name) for name in ('mujoco', 'gymnasium', 'dm-control')}
    detail = ', '.join(f'{name} {version or "missing"}' for name, version in versions.items())
    try:
        importlib.import_module('mujoco')
    except ImportError as error:
        return Check('MuJoCo', 'fail', f'cannot be imported: {error}', _INSTALL)
    except Exception as error:  # noqa: BLE001  it imports its driver: whatever that raises
        named = f'MUJOCO_GL={os.environ.get("MUJOCO_GL", "")}'
        remedy = 'no run works with a driver that is not there: unset MUJOCO_GL'
        detail = f'cannot be imported with {named}: {type(error).__name__}: {error}'
        return Check('MuJoCo', 'fail', detail, remedy)
    if not versions['gymnasium']:
        return Check('MuJoCo', 'fail', detail, _INSTALL)
    if not versions['dm-control']:
        return Check('MuJoCo', 'warn', detail, 'DM Control tasks need dm_control: install it')
    if versions['mujoco'] and int(versions['mujoco'].split('.')[0]) >= 4:
        return Check('MuJoCo', 'warn', detail, 'dm_control breaks with mujoco 4: install mujoco<4')
    return Check('MuJoCo', 'ok', detail)


def drawing(environ: Mapping[str, str] = os.environ) -> Check:
    """What draws the robot without a display: for reports, videos and pages."""
    drawn = rendering.find(environ)
    if drawn.driver is None:
        remedy = (
            'reports have no frames of the robot, and there are no videos; nothing else needs it. '
            'Install Mesa (libegl1 and libgl1-mesa-dri, or libosmesa6)'
        )
        return Check('rendering', 'warn', f'none: {drawn.text}', remedy)
    asked = ' (MUJOCO_GL is set)' if environ.get('MUJOCO_GL') else ''
    return Check('rendering', 'ok', f'MuJoCo draws with {drawn.driver}{asked}')


CHECKS: tuple[Callable[[], Check | list[Check]], ...] = (
    python,
    ros,
    middleware,
    messages,
    executables,
    discovery,
    leftovers,
    shared_memory,
    torch,
    compiler,
    simulators,
    drawing,
)


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Check that everything a run needs is there; the exit code is 1 if anything fails."""


def main(arguments: Sequence[str]) -> int:
    """Print a line for each check; exit code 1 if one fails."""
    from rich.text import Text

    from codetr_ros.cli.terminal import console, parse_arguments

    parse_arguments(Arguments, prog='codetr doctor', arguments=arguments)
    shown = console()
    failed = 0
    colours = {'ok': 'green', 'warn': 'yellow', 'fail': 'bold red'}
    for look in CHECKS:
        result = look()
        for check in result if isinstance(result, list) else [result]:
            line = Text(f'{check.status:4}  ', style=colours[check.status])
            line.append(f'{check.name}: {check.detail}', style='default')
            shown.print(line)
            if check.remedy:
                shown.print(f'      -> {check.remedy}')
            failed += check.status == 'fail'
    return 1 if failed else 0
