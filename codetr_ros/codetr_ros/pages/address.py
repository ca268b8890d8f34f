"""Where a page can be reached, and by whom."""

import errno
import ipaddress
import secrets
import socket
from collections.abc import Collection
from dataclasses import dataclass
from urllib.parse import urlsplit

HERE = '127.0.0.1'
"""The host of a page unless another is asked for: it answers to this machine only."""
LARGEST_PORT = 65535
WAITING = 128
"""Connections that may wait to be accepted."""


class PageError(RuntimeError):
    """A page that cannot be served: the message names the value and the remedy."""


@dataclass(frozen=True)
class Address:
    """An address that a server listens to.

    Attributes:
        host: the address of this machine, as it was asked for.
        port: the number that was asked for or, where that was 0, that was free.
        token: what a browser must show; None: nobody has to, since only this machine can ask.
        names: further names of this machine, by which browsers may ask for the page.
    """

    host: str
    port: int
    token: str | None = None
    names: Collection[str] = ()

    @property
    def url(self) -> str:
        """What opens the page, with the token if it asks for one."""
        host = socket.gethostname() if _anywhere(self.host) else self.host
        shown = f'[{host}]' if ':' in host else host
        query = f'?token={self.token}' if self.token else ''
        return f'http://{shown}:{self.port}/{query}'

    def admits(self, host: str) -> bool:
        """Whether a request that names this host (the header `Host`) is meant for this page.

        A page elsewhere can let its own name point to this machine, and a browser then takes this
        server for that page's. So names are admitted that belong to this machine, and addresses,
        which nobody can point elsewhere.
        """
        name, port = _split(host)
        if port != self.port:
            return False
        if not _is_address(name):
            return name.lower() in self._own_names()
        return not self.here_only or _is_loopback(name)

    def _own_names(self) -> set[str]:
        own = {'localhost', *self.names, self.host}
        if not self.here_only:
            own |= {socket.gethostname(), socket.getfqdn()}
        return {name.lower() for name in own}

    @property
    def here_only(self) -> bool:
        """Whether only this machine can reach the page."""
        return _is_loopback(self.host)


def listen(
    host: str = HERE, port: int = 0, names: Collection[str] = ()
) -> tuple[socket.socket, Address]:
    """Listen to an address of this machine.

    Args:
        host: the address or name; any but this machine's own asks browsers for a token.
        port: a number from 1 to 65535; 0: any that is free.
        names: further names of this machine, by which browsers may ask for the page.

    Returns:
        The socket, and its address with a new token if it needs one.

    Raises:
        PageError: there is no such address here, or the port is taken.
    """
    if not 0 <= port <= LARGEST_PORT:
        raise PageError(f'--port {port} is no port: give 1 to {LARGEST_PORT}, or 0 for a free one')
    try:
        family, _, _, _, place = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
    except (OSError, UnicodeError) as error:
        raise PageError(
            f'--host {host!r} is unknown here ({error}): give an address of this machine, '
            f'{HERE} for this machine only, 0.0.0.0 for all that reach it'
        ) from None
    opened = socket.socket(family, socket.SOCK_STREAM)
    try:
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        opened.bind(place)
        opened.listen(WAITING)
    except OSError as error:
        opened.close()
        raise PageError(_why_not(host, port, error)) from None
    bound = opened.getsockname()
    token = None if _is_loopback(bound[0]) else secrets.token_urlsafe(32)
    return opened, Address(host, bound[1], token, tuple(names))


def _why_not(host: str, port: int, error: OSError) -> str:
    if error.errno == errno.EADDRINUSE:
        return f'--port {port} of {host} is taken: choose another, or leave it out for a free one'
    if error.errno == errno.EACCES:
        return f'--port {port} is not yours to open: choose one from 1024, or leave it out'
    return (
        f'--host {host} cannot be listened to ({error.strerror}): give an address of this machine'
    )


def _split(host: str) -> tuple[str, int | None]:
    """Name and port of a header `Host`; an empty name if it is none."""
    try:
        parts = urlsplit(f'//{host}')
        if parts.path or parts.query or parts.fragment or parts.username is not None:
            return '', None
        return parts.hostname or '', parts.port or 80
    except ValueError:
        return '', None


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _is_loopback(name: str) -> bool:
    if name == 'localhost':
        return True
    return _is_address(name) and ipaddress.ip_address(name).is_loopback


def _anywhere(name: str) -> bool:
    return _is_address(name) and ipaddress.ip_address(name).is_unspecified
