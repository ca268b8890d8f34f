"""What the set-up says when a machine lacks something: what is missing, and the remedy."""

import ast
import builtins
import sys
import sysconfig
from pathlib import Path

import pytest

import bootstrap
import bootstrap_checks as checks
from bootstrap_checks import SetupError

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize('version', [(3, 9, 18), (3, 14, 0), (2, 7, 18)])
def test_a_python_without_ros_wheels_is_refused_with_the_way_to_name_another(version: tuple):
    with pytest.raises(SetupError) as error:
        checks.check_python(version, 'linux')
    assert '.'.join(map(str, version)) in str(error.value)
    assert 'Python 3.10 to 3.13' in str(error.value)
    assert 'PYTHON=python3.12' in str(error.value)


@pytest.mark.parametrize('minor', [10, 11, 12, 13])
def test_every_python_with_ros_wheels_is_accepted(minor: int):
    checks.check_python((3, minor, 0), 'linux')


def test_a_system_other_than_linux_is_refused():
    with pytest.raises(SetupError, match="'darwin'.*for Linux only"):
        checks.check_python((3, 11, 7), 'darwin')


@pytest.mark.parametrize('name', sorted(path.name for path in ROOT.glob('bootstrap*.py')))
def test_an_old_python_can_read_the_script_that_refuses_it(name: str):
    ast.parse((ROOT / name).read_text(), feature_version=(3, 6))


def test_a_folder_in_which_nothing_can_be_written_is_refused():
    # /proc refuses new files even to root, whom file modes do not stop
    with pytest.raises(SetupError, match='cannot write into /proc .*Copy the project'):
        checks.check_folder(Path('/proc'))


@pytest.mark.parametrize('name', ['with blank', 'x' * checks.LONGEST_PATH])
def test_a_path_that_no_script_can_name_is_refused(tmp_path: Path, name: str):
    with pytest.raises(SetupError, match='no blanks and at most 100 characters. Move the project'):
        checks.check_folder(tmp_path / name)


def test_a_disk_that_is_too_small_is_refused_with_what_is_free_and_what_is_needed(tmp_path: Path):
    checks.check_space(tmp_path, needed=1)
    with pytest.raises(SetupError, match=r'has \d+\.\d GB free.*need 1000000000 GB'):
        checks.check_space(tmp_path, needed=10**18)


@pytest.mark.parametrize(
    ('present', 'missing'),
    [((), 'C compiler'), (('cc',), r'C\+\+ compiler'), (('cc', 'c++'), 'make')],
)
def test_a_missing_compiler_or_make_is_named_with_the_package_that_brings_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, present: tuple[str, ...], missing: str
):
    monkeypatch.delenv('CC', raising=False)
    monkeypatch.delenv('CXX', raising=False)
    for name in present:
        (tmp_path / name).touch(mode=0o755)
    with pytest.raises(SetupError, match=f'there is no {missing}.*apt install build-essential'):
        checks.check_compilers(search=str(tmp_path))


def test_a_compiler_that_the_environment_names_but_nobody_has_is_called_by_that_name(
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setenv('CC', 'no-such-compiler -O2')
    with pytest.raises(SetupError, match="looked for 'no-such-compiler'"):
        checks.check_compilers()


def test_missing_headers_of_python_are_named_with_the_package_that_brings_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    for name in ('cc', 'c++', 'make'):
        (tmp_path / name).touch(mode=0o755)
    monkeypatch.delenv('CC', raising=False)
    monkeypatch.delenv('CXX', raising=False)
    checks.check_compilers(str(tmp_path), sysconfig.get_config_var('INCLUDEPY'))
    with pytest.raises(SetupError, match=r'no \S+/Python\.h: .*apt install python3\.\d+-dev'):
        checks.check_compilers(str(tmp_path), str(tmp_path))


def test_a_python_without_the_module_that_makes_environments_is_refused(
    monkeypatch: pytest.MonkeyPatch,
):
    real = builtins.__import__

    def without_ensurepip(name, *args, **kwargs):
        if name == 'ensurepip':
            raise ModuleNotFoundError("No module named 'ensurepip'", name='ensurepip')
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, '__import__', without_ensurepip)
    version = f'{sys.version_info.major}.{sys.version_info.minor}'
    with pytest.raises(
        SetupError, match=f"no module 'ensurepip'.*apt install python{version}-venv"
    ):
        checks.check_venv_module()


@pytest.mark.parametrize(
    ('printed', 'said'),
    [
        (
            'WARNING: Retrying ... NewConnectionError: Temporary failure in name resolution\n'
            'ERROR: No matching distribution found for numpy==2.4.6',
            'the package index cannot be reached',
        ),
        ('OSError: [Errno 28] No space left on device', 'the disk is full'),
        ('SSLError(SSLCertVerificationError: CERTIFICATE_VERIFY_FAILED', 'PIP_CERT='),
        (
            'ERROR: No matching distribution found for ros-jazzy-rclpy==7.1.6',
            'no ros-jazzy-rclpy==7.1.6 for this Python',
        ),
        ('something else', 'Its last lines are above'),
    ],
)
def test_what_pip_printed_is_turned_into_what_to_do(printed: str, said: str):
    assert said in checks.explain_pip(printed)


def test_a_failure_is_one_message_without_a_traceback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def refuse(root):
        raise SetupError(f'{root} is not to my liking. Move the project.')

    monkeypatch.setattr(bootstrap, 'check_folder', refuse)
    assert bootstrap.main() == 1
    assert capsys.readouterr().err == f'set-up: {ROOT} is not to my liking. Move the project.\n'
