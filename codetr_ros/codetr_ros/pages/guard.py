"""Who is answered: checks that every request passes before any page sees it.

A browser that shows somebody else's page can be made to ask this server too. So a request must
name this machine (`Host`) and must not come from another page (`Origin`, `Sec-Fetch-Site`). It
must show the token where other machines can reach the server. What browsers may do with the
answers is stated in headers: run only the scripts that the server itself sends, and load nothing
from elsewhere.
"""

import hmac
from collections.abc import Iterable
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, quote

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from codetr_ros.pages.address import Address

MOST_BYTES = 65_536
"""The most bytes of a request's body."""
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; "
    "media-src 'self' blob:; connect-src 'self'; form-action 'self'; base-uri 'none'; "
    "frame-ancestors 'none'; require-trusted-types-for 'script'; trusted-types 'none'"
)
HEADERS = {
    'Content-Security-Policy': POLICY,
    'X-Content-Type-Options': 'nosniff',
    'X-Frame-Options': 'DENY',
    'Referrer-Policy': 'no-referrer',  # the address may hold the token
    'Cross-Origin-Opener-Policy': 'same-origin',
    'Cross-Origin-Resource-Policy': 'same-origin',
    'Cache-Control': 'no-store',
}
READING = ('GET', 'HEAD')


class Guard:
    """Refuses what is not meant for the pages, and adds headers to what they answer.

    Args:
        inner: the pages.
        address: where they are served.
        most_bytes: of a request's body.
    """

    def __init__(self, inner: ASGIApp, address: Address, most_bytes: int = MOST_BYTES) -> None:
        self._inner = inner
        self._address = address
        self._most = most_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        if scope['type'] != 'http':
            raise ValueError(f'a connection of type {scope["type"]!r} is not served')

        async def send_guarded(message: Message) -> None:
            if message['type'] == 'http.response.start':
                MutableHeaders(scope=message).update(HEADERS)
            await send(message)

        headers = Headers(scope=scope)
        answer = self._refusal(scope, headers) or self._admission(scope, headers)
        if answer is not None:
            await answer(scope, receive, send_guarded)
            return
        if scope['method'] in READING:
            await self._inner(scope, receive, send_guarded)
            return
        body = await _body(receive, self._most)
        if body is None:
            text = f'a request may hold {self._most} bytes'
            await PlainTextResponse(text, 413)(scope, receive, send_guarded)
            return
        await self._inner(scope, _given(body, receive), send_guarded)

    def _refusal(self, scope: Scope, headers: Headers) -> Response | None:
        """The answer to a request that is not meant for this server."""
        hosts = headers.getlist('host')
        if len(hosts) != 1 or not self._address.admits(hosts[0]):
            text = f'{", ".join(hosts) or "no host"} is not served here: open the printed address'
            return PlainTextResponse(text, 421)
        origin = headers.get('origin')
        elsewhere = headers.get('sec-fetch-site') in ('cross-site', 'same-site')
        opened = scope['method'] in READING and headers.get('sec-fetch-mode') == 'navigate'
        if (origin is not None and origin != f'http://{hosts[0]}') or (elsewhere and not opened):
            return PlainTextResponse('another page must not ask this server', 403)
        if scope['method'] not in READING:
            kind = headers.get('content-type', '').partition(';')[0].strip().lower()
            if kind != 'application/json':
                return PlainTextResponse('what is sent must be application/json', 415)
        return None

    def _admission(self, scope: Scope, headers: Headers) -> Response | None:
        """The answer to a request that is not admitted yet; None: it is."""
        token = self._address.token
        if token is None or _same(_bearer(headers), token):
            return None
        name = f'codetr_{self._address.port}'  # browsers keep cookies by host, not by port
        if any(_same(value, token) for value in _cookies(headers.getlist('cookie'), name)):
            return None
        shown = parse_qs(scope['query_string'].decode('latin-1')).get('token', [])
        if scope['method'] in READING and len(shown) == 1 and _same(shown[0], token):
            # out of the address bar, the history and what people copy from there
            answer = RedirectResponse('/' + quote(scope['path'].lstrip('/')), 303)
            answer.set_cookie(name, token, httponly=True, samesite='lax', path='/')
            return answer
        text = 'this page asks for a token: open the whole address that was printed, with ?token='
        return PlainTextResponse(text, 401)


def _same(shown: str, token: str) -> bool:
    """Whether a token is the right one, in a time that does not depend on how much of it is."""
    return hmac.compare_digest(shown.encode(), token.encode())


def _bearer(headers: Headers) -> str:
    kind, _, value = headers.get('authorization', '').partition(' ')
    return value.strip() if kind.lower() == 'bearer' else ''


def _cookies(texts: Iterable[str], name: str) -> list[str]:
    found = []
    for text in texts:
        try:
            cookies = SimpleCookie(text)
        except CookieError:
            continue
        if name in cookies:
            found.append(cookies[name].value)
    return found


async def _body(receive: Receive, most: int) -> bytes | None:
    """The whole body of a request; None if it is longer, or its sender has gone."""
    body = bytearray()
    while True:
        message = await receive()
        if message['type'] == 'http.disconnect':
            return None
        body += message.get('body', b'')
        if len(body) > most:
            return None
        if not message.get('more_body', False):
            return bytes(body)


def _given(body: bytes, receive: Receive) -> Receive:
    """Hand on a body that was read, and then what else comes."""
    parts: list[Message] = [{'type': 'http.request', 'body': body, 'more_body': False}]

    async def hand_on() -> Message:
        return parts.pop() if parts else await receive()

    return hand_on
