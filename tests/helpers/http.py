"""Plain requests to a server of pages, with whatever headers a test wants."""

import http.client
from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Answer:
    status: int
    text: str
    headers: dict[str, str] = field(default_factory=dict)


def ask(
    port: int,
    path: str = '/',
    headers: Mapping[str, str] | None = None,
    method: str = 'GET',
    body: bytes | None = None,
) -> Answer:
    """Ask a server of this machine; `Host` is its own unless given."""
    connection = http.client.HTTPConnection('127.0.0.1', port, timeout=120)
    try:
        given = dict(headers or {})
        connection.putrequest(method, path, skip_host='Host' in given)
        for name, value in given.items():
            connection.putheader(name, value)
        if body is not None:
            connection.putheader('Content-Length', str(len(body)))
        connection.endheaders(body)
        answer = connection.getresponse()
        text = answer.read().decode()
        return Answer(answer.status, text, {n.lower(): v for n, v in answer.getheaders()})
    finally:
        connection.close()
