"""What pip is configured with, for uv.

uv does not read pip.conf. A machine behind a mirror, with wheels in a folder or with certificates
of its own is configured for pip, so what pip is configured with is translated. Whatever the user
has configured for uv (`UV_...`) counts instead.
"""

import ast
import os
import re

PYPI = 'https://pypi.org' + '/simple'
"""Where pip looks unless it is configured otherwise."""

INDEXES = ('UV_INDEX', 'UV_DEFAULT_INDEX', 'UV_INDEX_URL', 'UV_EXTRA_INDEX_URL')
OPTIONS = {
    'trusted-host': 'UV_INSECURE_HOST',
    'constraint': 'UV_CONSTRAINT',
    'build-constraint': 'UV_BUILD_CONSTRAINT',
    'timeout': 'UV_HTTP_TIMEOUT',
    'default-timeout': 'UV_HTTP_TIMEOUT',  # another name of the same option
    'retries': 'UV_HTTP_RETRIES',
    'client-cert': 'SSL_CLIENT_CERT',
}
"""Options of pip that take a value or several, and the variables that hold the same for uv."""
SWITCHES = {
    'pre': ('UV_PRERELEASE', 'allow'),
    'require-hashes': ('UV_REQUIRE_HASHES', 'true'),
    'no-cache-dir': ('UV_NO_CACHE', 'true'),
}
"""Options of pip that are on or off, and what says the same to uv."""
TRANSLATED = {
    *('index-url', 'extra-index-url', 'no-index', 'find-links', 'no-binary', 'only-binary'),
    *('cert', 'proxy', 'cache-dir', *OPTIONS, *SWITCHES),
}
WITHOUT_EFFECT = {
    *('disable-pip-version-check', 'no-python-version-warning', 'no-warn-script-location'),
    *('no-color', 'progress-bar', 'quiet', 'verbose', 'log', 'no-input', 'debug', 'compile'),
    *('require-virtualenv', 'root-user-action', 'break-system-packages', 'user', 'target'),
    *('prefer-binary', 'use-feature', 'use-deprecated', 'config-file', 'exists-action', 'prefix'),
}
"""Options of pip that do not decide which files it installs into a virtual environment."""


class NoCounterpartError(Exception):
    """pip is configured with something that cannot be translated: the message names it."""


def pip_options(listed):
    """What pip is configured with, from what `pip config list` prints.

    Returns:
        options by name. As in pip, those of `install` count before those of all commands, and
        variables of the environment (`PIP_...`) before both.
    """
    sections = {'global': {}, 'install': {}, ':env:': {}}
    for line in listed.splitlines():
        match = re.match(r"(global|install|:env:)\.([\w-]+)=('.*'|\".*\")$", line.strip())
        if match:
            section, name, value = match.groups()
            sections[section][name.replace('_', '-')] = ast.literal_eval(value)
    options = {}
    for section in sections.values():
        options.update(section)
    return options


def uv_configuration(options, environment):
    """Translate options of pip into what uv is called with.

    Args:
        options: of pip, as from `pip_options`.
        environment: variables that the user has set.

    Returns:
        flags for the command line, and variables for the environment.

    Raises:
        NoCounterpartError: an option decides what pip installs, and uv has nothing like it.
    """
    for name in sorted(options):
        if name not in TRANSLATED and name not in WITHOUT_EFFECT:
            raise NoCounterpartError(
                f'uv has no counterpart for the option {name!r} that pip is given'
            )
    flags = []
    variables = {'UV_SYSTEM_CERTS': 'true'}  # pip trusts what the system trusts; uv would not
    if not any(name in environment for name in INDEXES):
        if on(options, 'no-index'):
            flags.append('--no-index')
        elif options.get('index-url') or options.get('extra-index-url'):
            variables.update(indexes(options))
    folders = [os.path.expanduser(place) for place in options.get('find-links', '').split()]
    # pip warns of a folder that is not there, uv ends
    folders = [place for place in folders if '://' in place or os.path.isdir(place)]
    if folders:
        variables['UV_FIND_LINKS'] = ','.join(folders)
    for name in ('no-binary', 'only-binary'):
        for package in re.split(r'[\s,]+', options.get(name, '')):
            flags += [f'--{name}', package] if package else []
    for name, variable in OPTIONS.items():
        if options.get(name):
            value = options[name].partition('.')[0] if 'timeout' in name else options[name]
            variables[variable] = ' '.join(value.split())
    for name, (variable, value) in SWITCHES.items():
        if on(options, name):
            variables[variable] = value
    if options.get('cache-dir'):
        variables['UV_CACHE_DIR'] = os.path.join(os.path.expanduser(options['cache-dir']), 'uv')
    variables = {
        name: value for name, value in variables.items() if name not in environment
    }  # what the user has set for uv counts
    variables.update(network(options, environment))
    return flags, variables


def indexes(options):
    """The variables that give uv the indexes of pip.

    pip takes the best version that any index has. uv would take the best of the first index that
    knows the package at all, so as not to be given a stranger's package of the same name; here the
    indexes are the user's own and versions are pinned, and the same files as pip's are wanted. Of
    one version in several indexes uv takes the first one's files: the main index holds most.
    """
    places = [options.get('index-url') or PYPI, *options.get('extra-index-url', '').split()]
    variables = {'UV_DEFAULT_INDEX': places[-1]}
    if len(places) > 1:
        variables.update(UV_INDEX=' '.join(places[:-1]), UV_INDEX_STRATEGY='unsafe-best-match')
    return variables


def network(options, environment):
    """The variables for certificates and proxy, which in pip count before those of the system."""
    variables = {}
    cert = options.get('cert') or (
        '' if 'SSL_CERT_FILE' in environment else environment.get('REQUESTS_CA_BUNDLE')
    )
    if cert:
        cert = os.path.expanduser(cert)
        variables['SSL_CERT_DIR' if os.path.isdir(cert) else 'SSL_CERT_FILE'] = cert
    proxy = options.get('proxy')
    if proxy:
        proxy = proxy if '://' in proxy else f'http://{proxy}'
        for name in ('http_proxy', 'https_proxy', 'HTTP_PROXY', 'HTTPS_PROXY'):
            variables[name] = proxy
    return variables


def on(options, name):
    """Whether a switch of pip is set."""
    return options.get(name, '').lower() in ('1', 'true', 'yes', 'on', 't', 'y')
