"""uv installs the packages as pip is configured; where uv cannot, pip does, with the reason."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import bootstrap
from bootstrap_checks import SetupError
from bootstrap_options import PYPI, NoCounterpartError, pip_options, uv_configuration
from bootstrap_packages import UV, last_error, missing_requirement
from helpers.set_up import BY_PIP, EVERYTHING, PACKAGES, Recorded

NO_SUCH_VERSION = """Using Python 3.11.7 environment at: .venv
error: No solution found when resolving dependencies
  cause: Because there is no version of numpy==99.0 and you require numpy==99.0, we can conclude \
that your requirements are unsatisfiable.
"""
NO_SUCH_PACKAGE = """error: No solution found when resolving dependencies
  cause: Because no-such-thing was not found in the package registry and you require \
no-such-thing==1.0, we can conclude that your requirements are unsatisfiable.
"""
OTHER_WHEELS_ONLY = """error: No solution found when resolving dependencies
  cause: Because numpy==2.4.6 has no wheels with a matching Python ABI tag (e.g., `cp312`) and \
you require numpy==2.4.6, we can conclude that your requirements are unsatisfiable.
"""
NO_NETWORK = """error: Failed to fetch: http://127.0.0.1:9/packages/numpy/
  cause: error sending request for url (http://127.0.0.1:9/packages/numpy/)
  cause: Connection refused (os error 111)
"""


# What pip is configured with


def test_options_are_read_as_pip_counts_them():
    listed = """:env:.find-links='/from/environment'
global.find-links='/from/all /commands'
global.timeout='60'
install.timeout='90'
download.timeout='1'
global.index-url="https://user:it's@mirror.example/packages"
WARNING: something else
"""
    assert pip_options(listed) == {
        'find-links': '/from/environment',
        'timeout': '90',
        'index-url': "https://user:it's@mirror.example/packages",
    }


def test_options_of_the_pip_that_runs_the_tests_can_be_read(tmp_path: Path):
    file = tmp_path / 'pip.conf'
    file.write_text(
        '[global]\nextra-index-url =\n  https://one.example/packages\n  https://two.example/packages\n'
        '[install]\nno_cache_dir = true\n'
    )
    listed = subprocess.check_output(
        [sys.executable, '-m', 'pip', 'config', 'list'],
        env={'PIP_CONFIG_FILE': str(file), 'PIP_CERT': '/certificates', 'HOME': str(tmp_path)},
        text=True,
    )
    options = pip_options(listed)
    assert options['extra-index-url'].split() == [
        'https://one.example/packages',
        'https://two.example/packages',
    ]
    assert (options['no-cache-dir'], options['cert']) == ('true', '/certificates')


@pytest.mark.parametrize(
    ('options', 'flags', 'variables'),
    [
        ({}, [], {}),
        (
            {'index-url': 'https://mirror.example/packages'},
            [],
            {'UV_DEFAULT_INDEX': 'https://mirror.example/packages'},
        ),
        (
            {'extra-index-url': 'https://a.example/packages file:///b/packages'},
            [],
            {
                'UV_INDEX': f'{PYPI} https://a.example/packages',
                'UV_DEFAULT_INDEX': 'file:///b/packages',
                'UV_INDEX_STRATEGY': 'unsafe-best-match',
            },
        ),
        (
            {'find-links': '/ /no/such/folder https://wheels.example/', 'no-index': '1'},
            ['--no-index'],
            {'UV_FIND_LINKS': '/,https://wheels.example/'},
        ),
        ({'no-index': 'false'}, [], {}),
        ({'cert': '/c.pem'}, [], {'SSL_CERT_FILE': '/c.pem'}),
        (
            {'default-timeout': '180', 'retries': '7', 'trusted-host': 'a.example b.example:80'},
            [],
            {
                'UV_HTTP_TIMEOUT': '180',
                'UV_HTTP_RETRIES': '7',
                'UV_INSECURE_HOST': 'a.example b.example:80',
            },
        ),
        ({'timeout': '15.5'}, [], {'UV_HTTP_TIMEOUT': '15'}),
        (
            {'constraint': '/a.txt\n/b.txt', 'pre': 'true'},
            [],
            {'UV_CONSTRAINT': '/a.txt /b.txt', 'UV_PRERELEASE': 'allow'},
        ),
        (
            {'no-binary': 'numpy,scipy', 'only-binary': ':all:'},
            ['--no-binary', 'numpy', '--no-binary', 'scipy', '--only-binary', ':all:'],
            {},
        ),
        ({'cache-dir': '/big/pip'}, [], {'UV_CACHE_DIR': '/big/pip/uv'}),
        ({'no-cache-dir': 'true'}, [], {'UV_NO_CACHE': 'true'}),
        (
            {'proxy': 'proxy.example:3128'},
            [],
            dict.fromkeys(
                ('http_proxy', 'https_proxy', 'HTTP_PROXY', 'HTTPS_PROXY'),
                'http://proxy.example:3128',
            ),
        ),
        ({'disable-pip-version-check': '1', 'progress-bar': 'off'}, [], {}),
    ],
)
def test_what_pip_is_configured_with_reaches_uv(
    options: dict[str, str], flags: list[str], variables: dict[str, str]
):
    assert uv_configuration(options, {}) == (flags, {'UV_SYSTEM_CERTS': 'true', **variables})


def test_what_the_user_has_set_for_uv_counts_before_what_pip_is_configured_with():
    options = {
        'index-url': 'https://mirror.example/packages',
        'extra-index-url': 'https://more.example/packages',
        'no-index': 'true',
        'timeout': '60',
    }
    own = {'UV_INDEX_URL': 'https://mine.example/packages', 'UV_HTTP_TIMEOUT': '5'}
    assert uv_configuration(options, own) == ([], {'UV_SYSTEM_CERTS': 'true'})
    assert uv_configuration({}, {'UV_SYSTEM_CERTS': 'false'}) == ([], {})


def test_certificates_that_pip_takes_from_the_environment_reach_uv():
    _, variables = uv_configuration({}, {'REQUESTS_CA_BUNDLE': '/company.pem'})
    assert variables['SSL_CERT_FILE'] == '/company.pem'
    own = {'REQUESTS_CA_BUNDLE': '/company.pem', 'SSL_CERT_FILE': '/mine.pem'}
    assert 'SSL_CERT_FILE' not in uv_configuration({}, own)[1]
    assert uv_configuration({'cert': '/pip.pem'}, own)[1]['SSL_CERT_FILE'] == '/pip.pem'


def test_an_option_that_decides_what_is_installed_and_has_no_counterpart_is_named():
    with pytest.raises(
        NoCounterpartError, match="no counterpart for the option 'keyring-provider'"
    ):
        uv_configuration({'keyring-provider': 'import'}, {})


# What is done, and what is said


def run(setup: Recorded) -> list[str]:
    setup.run()
    return setup.stages


def test_pip_takes_over_where_no_index_has_uv_and_says_so(root: Path, capsys):
    class NoUv(Recorded):
        def call(self, stage, command, *more, **named):
            code, printed = super().call(stage, command, *more, **named)
            if UV in command:
                return 1, f'ERROR: No matching distribution found for {UV}'
            return code, printed

    done = run(NoUv(root))
    assert done == ['environment', 'installers', 'installers', *BY_PIP, 'workspace', 'check']
    printed = capsys.readouterr().out
    assert f'{UV} cannot be installed (ERROR: No matching distribution found' in printed
    assert 'pip installs the packages instead' in printed


@pytest.mark.parametrize(
    ('printed', 'reason'),
    [(OTHER_WHEELS_ONLY, 'no wheels with a matching'), (NO_NETWORK, 'Connection refused')],
)
def test_pip_takes_over_where_uv_fails_in_an_environment_made_anew_and_the_reason_is_said(
    root: Path,
    capsys,
    printed: str,
    reason: str,
):
    setup = Recorded(root, fail='packages', code=1, printed=printed)
    assert run(setup) == [
        *('environment', *PACKAGES[:3]),
        *('environment', 'installers', *BY_PIP),
        *EVERYTHING[-2:],
    ]
    assert not (setup.site / 'half').exists()
    assert reason in capsys.readouterr().out
    assert run(Recorded(root)) == []


def test_an_installation_by_pip_after_uv_that_is_interrupted_is_begun_again(root: Path):
    class Interrupted(Recorded):
        def call(self, stage, command, *more, **named):
            code, printed = super().call(stage, command, *more, **named)
            return (-2 if self.stages[-1] == 'packages by pip' else code), printed

    with pytest.raises(SetupError):
        Interrupted(root, fail='packages').run()
    assert run(Recorded(root)) == EVERYTHING


@pytest.mark.parametrize(
    ('printed', 'missing'),
    [(NO_SUCH_VERSION, 'numpy==99.0'), (NO_SUCH_PACKAGE, 'no-such-thing==1.0')],
)
def test_a_requirement_that_no_index_has_is_named_with_the_remedy(
    root: Path,
    printed: str,
    missing: str,
):
    setup = Recorded(root, fail='packages', code=1, printed=printed)
    with pytest.raises(SetupError) as error:
        setup.run()
    assert f'the package index has no {missing} for this Python' in str(error.value)
    assert 'check which index pip uses: python3 -m pip config list' in str(error.value)
    assert setup.stages[-1] == 'packages', 'pip was asked for what uv knows to be missing'


def test_a_full_disk_is_said_at_once(root: Path):
    printed = 'error: Failed to install: torch.whl\n  cause: No space left on device (os error 28)'
    setup = Recorded(root, fail='packages', code=2, printed=printed)
    with pytest.raises(SetupError, match='the disk is full.*UV_CACHE_DIR='):
        setup.run()
    assert setup.stages[-1] == 'packages'
    assert run(Recorded(root)) == EVERYTHING


def test_the_line_that_says_what_is_wrong_is_found_in_what_was_printed():
    assert last_error(NO_NETWORK) == (
        'error: Failed to fetch: http://127.0.0.1:9/packages/numpy/; '
        'cause: Connection refused (os error 111)'
    )
    assert last_error('one\ntwo\n') == 'two'
    assert last_error('') == 'it printed nothing'


@pytest.mark.skipif(
    shutil.which('uv', path=str(Path(sys.executable).parent)) is None, reason='no uv'
)
@pytest.mark.parametrize('requirement', ['codetr-ros-msgs-none==1.0', 'pip==0.0.99'])
def test_uv_still_says_in_these_words_that_no_index_has_a_requirement(
    tmp_path: Path, requirement: str
):
    index = tmp_path / 'simple' / 'pip'
    index.mkdir(parents=True)
    (index / 'index.html').write_text(
        '<a href="pip-9.0-py3-none-any.whl">pip-9.0-py3-none-any.whl</a>'
    )
    done = subprocess.run(
        [
            *(
                str(Path(sys.executable).parent / 'uv'),
                'pip',
                'install',
                '--dry-run',
                '--no-config',
            ),
            *('--python', sys.executable, '--color', 'never', requirement),
        ],
        env={'UV_DEFAULT_INDEX': index.parent.as_uri(), 'HOME': str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert missing_requirement(done.stderr) == requirement, done.stderr


def test_what_pip_is_configured_with_is_not_written_to_a_log(root: Path):
    setup = bootstrap.Setup(root)
    setup.venv.mkdir()
    secret = [sys.executable, '-S', '-c', 'print("https://user:password@mirror.example")']
    assert 'password' in setup.call('options', secret, secret=True)[1]
    assert not any('password' in file.read_text() for file in setup.venv.iterdir())
