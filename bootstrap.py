"""Make the environment that `make train` and `make test` run in.

It is `.venv`: a virtual environment that is also the prefix into which ROS 2 is installed.

Three stages, each done again only when what it depends on has changed:

1. environment: a virtual environment of the Python that runs this script;
2. packages: everything the requirements files pin, ROS 2 Jazzy from wheels included;
3. workspace: `colcon build` of our ROS packages into the environment. Python packages are linked,
   not copied: edits take effect at once.

`.venv/setup.json` says what has been done. This script needs the standard library only, and any
Python from 3.6 can at least read it, so as to be told what is wrong.
"""

import contextlib
import fcntl
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import time
from pathlib import Path

from bootstrap_checks import (
    SetupError,
    check_compilers,
    check_folder,
    check_python,
    check_space,
    check_venv_module,
    say,
    tail,
)
from bootstrap_packages import PIP, UV, Packages, PackagesError

REQUIREMENTS = (
    'requirements.txt',
    'requirements-ros.txt',
    'requirements-test.txt',
    'requirements-ray.txt',  # optional for users, but what it is for is tested
    'requirements-docs.txt',  # the same
)
WITHOUT_DEPENDENCIES = 'requirements-no-deps.txt'
PACKAGES = ('msgs', 'codetr_ros', 'sim_node', 'reward_node', 'learner_node')

FOREIGN = {
    *('PYTHONPATH', 'PYTHONHOME', 'LD_LIBRARY_PATH', '_ROS_WHEELS_BOOTSTRAP_COMPLETE'),
    *('AMENT_PREFIX_PATH', 'CMAKE_PREFIX_PATH', 'COLCON_PREFIX_PATH', 'COLCON_DEFAULTS_FILE'),
    *('ROS_DISTRO', 'CONDA_PREFIX', 'PIP_USER', 'PIP_TARGET', 'PIP_PREFIX'),
    *('UV_PYTHON', 'UV_SYSTEM_PYTHON', 'UV_WORKING_DIR', 'UV_PROJECT'),
    *('MAKEFLAGS', 'MFLAGS', 'MAKELEVEL'),
}
"""Variables that would let another ROS, another environment or the calling make into this one."""


class Setup:
    """The environment of one project folder, and what has been done to it."""

    def __init__(self, root):
        self.root = Path(root)
        self.venv = self.root / '.venv'
        self.python = self.venv / 'bin' / 'python'
        self.state_file = self.venv / 'setup.json'
        library = f'python{sys.version_info[0]}.{sys.version_info[1]}'
        self.site = self.venv / 'lib' / library / 'site-packages'
        self.headers = sysconfig.get_config_var('INCLUDEPY')

    # What there is

    def identity(self):
        """What an environment cannot change without being made anew."""
        return {
            'python': list(sys.version_info[:2]),
            'headers': self.headers,
            'path': str(self.venv),
        }

    def state(self):
        """What `setup.json` says; empty where there is none that can be read."""
        try:
            state = json.loads(self.state_file.read_text())
        except (OSError, ValueError):
            return {}
        return state if isinstance(state, dict) else {}

    def save(self, state):
        """Replace `setup.json` at one stroke: an interruption leaves the old one or the new."""
        temporary = self.state_file.with_suffix('.new')
        with temporary.open('w') as file:
            json.dump(state, file, indent=1)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(self.state_file)

    def packages_hash(self):
        """Changes whenever other packages are asked for."""
        return digest(
            [
                (name, (self.root / name).read_bytes())
                for name in (*REQUIREMENTS, WITHOUT_DEPENDENCIES)
            ]
            + [('installers', f'{PIP} {UV}'.encode())]
        )

    def workspace_hash(self):
        """Changes whenever colcon would install something else; linked files count by name."""
        found = [('bootstrap.py', Path(__file__).read_bytes())]
        for package in PACKAGES:
            folder = self.root / package
            for name in (
                'package.xml',
                'setup.py',
                'setup.cfg',
                'CMakeLists.txt',
                'msg/*',
                'srv/*',
            ):
                found += [(str(path), path.read_bytes()) for path in folder.glob(name)]
            for name in ('resource/*', 'launch/*.py', 'config/*.yaml'):
                found += [(str(path), b'') for path in folder.glob(name)]
        return digest(found)

    # The stages

    def run(self):
        """Do what is missing. Returns whether anything was."""
        started = time.time()
        state = self.state()
        wanted = {
            'identity': self.identity(),
            'packages': self.packages_hash(),
            'workspace': self.workspace_hash(),
        }
        links = (self.python, self.venv / 'bin' / 'codetr')
        if state == wanted and all(link.exists() for link in links):
            return False
        check_compilers()
        if not self.usable(state):
            check_space(self.root)
            self.make_environment()
            state = {}
        if state.get('packages') != wanted['packages']:
            self.install_packages()
        state = {'identity': wanted['identity'], 'packages': wanted['packages']}
        self.save(state)
        self.build_workspace()
        self.save(wanted)
        say(f'ready after {time.time() - started:.0f} s. What has been done is not done again.')
        return True

    def usable(self, state):
        """Whether the environment that is there can be kept; says why not."""
        if not self.venv.exists():
            return False
        if not (self.venv / 'pyvenv.cfg').is_file() and any(self.venv.iterdir()):
            raise SetupError(
                f'{self.venv} is there but is no virtual environment. Move it out of the way.'
            )
        identity = state.get('identity')
        if identity is None and not state and self.python.exists() and self.site.is_dir():
            pip = self.venv / 'bin' / 'pip'  # comes last, and names the place it was made for
            return pip.exists() and str(self.venv) in pip.read_text(errors='replace')
        if identity != self.identity() or not self.python.exists():
            say('the environment was made by another Python or in another place: making it anew')
            return False
        if state.get('busy'):
            say('the last set-up was interrupted: making the environment anew')
            return False
        return True

    def make_environment(self):
        """Stage 1. An environment that is there is replaced."""
        check_venv_module()
        say(f'environment: {self.venv} with Python {sys.version.split()[0]}')
        removed = (
            self.root / '.venv-removed'
        )  # half a removal must not look like half an environment
        if self.venv.is_symlink():
            self.venv.unlink()
        elif self.venv.exists():
            shutil.rmtree(str(removed), ignore_errors=True)
            self.venv.rename(removed)
        shutil.rmtree(str(removed), ignore_errors=True)
        code, output = self.call('environment', [sys.executable, '-m', 'venv', str(self.venv)])
        if code:
            raise SetupError(f'{sys.executable} -m venv failed:\n{tail(output)}')

    def renew_environment(self):
        """Make the environment anew while its packages are being installed."""
        self.make_environment()
        self.mark_busy()

    def mark_busy(self):
        """Note that packages are being installed: an interruption leaves some half installed."""
        self.save({'identity': self.identity(), 'busy': 'packages'})

    def install_packages(self):
        """Stage 2."""
        say('packages: 2 GB or more the first time')
        self.mark_busy()
        try:
            Packages(self, REQUIREMENTS, WITHOUT_DEPENDENCIES).install()
        except PackagesError as error:
            if error.restored:
                self.save({'identity': self.identity()})
            raise

    def build_workspace(self):
        """Stage 3."""
        mend_cmake_files(self.venv / 'share', self.headers, self.site)
        say('workspace: ' + ', '.join(PACKAGES))
        build = self.venv / 'colcon' / 'build'
        for package in PACKAGES[1:]:
            # links to files that are gone would stop the build; these packages build in a second
            shutil.rmtree(str(build / package), ignore_errors=True)
        colcon = [
            str(self.python),
            '-m',
            'colcon',
            '--log-base',
            str(self.venv / 'colcon' / 'log'),
            'build',
        ]
        colcon += ['--merge-install', '--symlink-install', '--install-base', str(self.venv)]
        colcon += ['--build-base', str(build), '--base-paths', *PACKAGES]
        colcon += ['--cmake-args', '-DCMAKE_BUILD_TYPE=Release', '-DBUILD_TESTING=OFF']
        # there are no wheels of rclcpp, so that nothing here could use the messages from C++
        colcon += [f'-DPython3_EXECUTABLE={self.python}', '-DCODETR_MSGS_PYTHON_ONLY=ON']
        # else colcon has make wait while the load is high, as it still is after stage 2
        jobs = {'MAKEFLAGS': f'-j{len(os.sched_getaffinity(0))}'}
        code, output = self.call('workspace', colcon, jobs)
        if code:
            raise SetupError(
                f'{tail(output, 40)}\n\nset-up: the workspace does not build (its whole output: '
                f'{self.log("workspace")}). If you changed nothing, make clean and try again.'
            )
        # colcon leaves linked packages to hooks that must be sourced first; this need not be
        folders = [self.root / package for package in PACKAGES[1:]] + [
            build / package for package in PACKAGES[1:]
        ]
        (self.site / 'codetr_workspace.pth').write_text(
            ''.join(f'{folder}\n' for folder in folders)
        )
        command = self.venv / 'bin' / 'codetr'
        if not command.is_symlink():
            command.symlink_to(Path('..', 'lib', 'codetr_ros', 'codetr'))
        modules = [*PACKAGES[1:], 'codetr_msgs.msg', 'codetr_msgs.srv', 'rclpy']
        code, output = self.call('check', [str(self.python), '-c', f'import {", ".join(modules)}'])
        if code:
            raise SetupError(
                f'what was built cannot be imported; make clean and try again:\n{tail(output)}'
            )

    # How they are run

    def log(self, stage):
        """File that holds everything a stage printed."""
        return self.venv / f'setup-{stage}.log'

    def call(self, stage, command, variables=None, secret=False):
        """Run a command in the project folder with nothing foreign in its environment.

        Args:
            stage: names the log that everything printed goes to.
            command: words of the command line.
            variables: more of them for its environment.
            secret: whether what it prints may hold passwords: it is neither shown nor kept.

        Returns:
            exit code (negative: killed by that signal) and what was printed, also in `log(stage)`.
        """
        environment = {name: value for name, value in os.environ.items() if name not in FOREIGN}
        if self.venv.is_dir():
            environment.update(
                PATH=f'{self.venv / "bin"}{os.pathsep}{environment.get("PATH", os.defpath)}',
                VIRTUAL_ENV=str(self.venv),
                AMENT_PREFIX_PATH=str(self.venv),
                CMAKE_PREFIX_PATH=str(self.venv),
                COLCON_HOME=str(
                    self.venv / 'colcon'
                ),  # not the user's: it may change what colcon does
            )
        environment.update(variables or {})
        lines = []
        process = subprocess.Popen(
            command,
            cwd=str(self.root),
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            universal_newlines=True,
            errors='replace',
        )
        with process:
            for line in process.stdout:
                lines.append(line)
                if not secret:
                    show(line)
        show('')
        output = ''.join(lines)
        if self.venv.is_dir() and not secret:
            self.log(stage).write_text(f'$ {" ".join(command)}\n{output}', errors='replace')
        return process.returncode, output


def mend_cmake_files(share, headers, site):
    """Put this machine's directories into the CMake files of the wheels.

    The wheels' exported CMake files name Python's headers and site-packages where they lay on the
    machine that built them (/opt/python/cpXY-cpXY); CMake refuses directories that do not exist.
    Done again, it changes nothing.

    Returns:
        how many files were changed.
    """
    changed = 0
    for path in Path(share).rglob('*.cmake'):
        before = path.read_text()
        after = re.sub(
            r'/opt/python/cp\w+-cp\w+/include/python[\d.]+\w*', lambda _: str(headers), before
        )
        after = re.sub(
            r'/opt/python/cp\w+-cp\w+/lib/python[\d.]+\w*/site-packages',
            lambda _: str(site),
            after,
        )
        if after != before:
            # a new file: the old one is also a name of that in uv's cache, for all environments
            mended = path.with_suffix('.mended')
            mended.write_text(after)
            mended.replace(path)
            changed += 1
    return changed


def digest(found):
    """sha256 over names and contents, whatever order they were found in."""
    total = hashlib.sha256()
    for name, content in sorted(found):
        total.update(f'{name}\0{len(content)}\0'.encode())
        total.update(content)
    return total.hexdigest()


def show(line):
    """Show on a terminal, in one line that is overwritten, that something still happens."""
    if sys.stdout.isatty():
        width = max(20, shutil.get_terminal_size().columns - 1)
        print(f'\r\033[K{line.strip()[:width]}' if line else '\r\033[K', end='', flush=True)


@contextlib.contextmanager
def alone(root):
    """One set-up at a time: a second one waits for the first, and then finds everything done."""
    handle = os.open(str(root), os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            say('another set-up is at work in this folder: waiting for it')
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def main():
    """Set up the folder that this file lies in. Returns the exit code."""
    root = Path(__file__).resolve().parent
    try:
        check_python(sys.version_info)
        check_folder(root)
        with alone(root):
            Setup(root).run()
    except SetupError as error:
        print(f'set-up: {error}', file=sys.stderr)
        return 1
    except OSError as error:
        place = f' ({error.filename})' if error.filename else ''
        print(f'set-up: {error.strerror}{place}. Mend that and try again.', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print('set-up: interrupted. The next one begins this part again.', file=sys.stderr)
        return 130
    return 0


if __name__ == '__main__':
    sys.exit(main())
