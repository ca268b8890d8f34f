"""Stage 2 of the set-up: uv installs the packages; where it cannot, pip does."""

import os
import re

from bootstrap_checks import (
    SetupError,
    explain_pip,
    is_full,
    machine_fault,
    say,
    tail,
    unknown_package,
)
from bootstrap_options import NoCounterpartError, pip_options, uv_configuration

PIP = 'pip==26.3'
"""The pip that comes with Python 3.10 gives up on the requirements instead of resolving them."""
UV = 'uv==0.13.9'
"""Its messages are read (`missing_requirement`): look at them again with another version."""


class PackagesError(SetupError):
    """The packages cannot be installed. `restored` says that the environment is as it was."""

    def __init__(self, message, restored):
        super().__init__(message)
        self.restored = restored


class Packages:
    """What is to be installed, and into which environment."""

    def __init__(self, setup, requirements, without_dependencies):
        self.setup = setup
        # all in one call: a second one lifts setuptools over what colcon allows
        everything = [word for name in requirements for word in ('-r', name)]
        self.calls = (
            ('packages', everything),
            ('packages-bare', ['--no-deps', '-r', without_dependencies]),
        )

    def install(self):
        """Install everything with uv, or else with pip.

        Raises:
            PackagesError: neither can; the message says why and what to do.
        """
        reason = self.install_uv()
        if not reason:
            before = self.content()
            reason = self.with_uv()
            if reason and self.content() != before:
                # unlike pip, uv does not put back what it began to change
                self.setup.renew_environment()
                self.pip('installers', [PIP])
        if reason:
            say(f'{reason}\nset-up: pip installs the packages instead, which takes longer')
            for stage, arguments in self.calls:
                self.pip(stage, arguments)

    def install_uv(self):
        """Bring pip up to date and install uv from pip's index. Returns why uv is not there."""
        code, output = self.call_pip('installers', [PIP, UV])
        if code == 0:
            return ''
        if code < 0 or machine_fault(output):
            raise PackagesError(f'{tail(output)}\n\nset-up: {explain_pip(output)}', code > 0)
        self.pip('installers', [PIP])
        return f'{UV} cannot be installed ({last_error(output)})'

    def with_uv(self):
        """Install everything with uv. Returns why it could not."""
        setup = self.setup
        code, listed = setup.call(
            'options', [str(setup.python), '-m', 'pip', 'config', 'list'], secret=True
        )
        if code:
            return f'what pip is configured with cannot be read ({last_error(listed)})'
        try:
            flags, variables = uv_configuration(pip_options(listed), os.environ)
        except NoCounterpartError as error:
            return str(error)
        uv = [str(setup.venv / 'bin' / 'uv'), 'pip', 'install', '--color', 'never']
        uv += ['--no-progress', '--python', str(setup.python), *flags]
        for stage, arguments in self.calls:
            before = self.content()
            code, output = setup.call(stage, uv + arguments, variables)
            if code == 0:
                continue
            restored = code > 0 and self.content() == before
            missing = missing_requirement(output)
            if missing:
                remedy = unknown_package(missing)
            elif is_full(output):
                remedy = machine_fault(output)
            elif code < 0:
                remedy = f'uv was ended by signal {-code}. Try again.'
            else:
                return f'uv failed ({last_error(output)})'
            raise PackagesError(f'{tail(output)}\n\nset-up: {remedy}', restored)
        return ''

    def pip(self, stage, arguments):
        """Install with pip.

        Raises:
            PackagesError: pip failed, and put everything back if it ended by itself.
        """
        code, output = self.call_pip(stage, arguments)
        if code:
            raise PackagesError(f'{tail(output)}\n\nset-up: {explain_pip(output)}', code > 0)

    def call_pip(self, stage, arguments):
        """Run `pip install`. Returns its exit code and what it printed."""
        pip = [str(self.setup.python), '-m', 'pip', '--disable-pip-version-check', 'install']
        return self.setup.call(stage, pip + arguments)

    def content(self):
        """Names in site-packages: an installation that has begun adds or removes some."""
        return sorted(os.listdir(str(self.setup.site)))


def missing_requirement(output):
    """The requirement that no index has, from what uv printed; None where it names none.

    Wheels for other machines only do not count: pip may find the right one in another index.
    """
    match = re.search(r'[Bb]ecause there is no version of (\S+) and you require', output)
    match = match or re.search(
        r'[Bb]ecause \S+ was not found in the package registry and you require ([^\s,]+)', output
    )
    return match.group(1).rstrip(',') if match else None


def last_error(output):
    """The line in which a failed uv or pip says what is wrong, cause included."""
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    errors = [n for n, line in enumerate(lines) if line.lower().startswith('error')]
    if not errors:
        return lines[-1] if lines else 'it printed nothing'
    first = errors[0]
    causes = [line for line in lines[first + 1 :] if line.startswith('cause:')]
    return '; '.join([lines[first], *causes[-1:]])
