"""Who is answered, by whom a page may be asked, and what a browser may do with it."""

import http.client
import re
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import pytest
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from codetr_ros.pages.address import Address, PageError
from codetr_ros.pages.feed import Feed, to_json
from codetr_ros.pages.guard import HEADERS, MOST_BYTES
from codetr_ros.pages.server import STATIC, Server
from helpers.http import ask


async def echo(request: Request) -> Response:
    return JSONResponse(await request.json())


ROUTES = [Route('/echo', echo, methods=['POST']), Route('/', lambda _: Response('hello'))]
JSON = {'Content-Type': 'application/json'}


@pytest.fixture
def feed() -> Feed:
    return Feed()


@pytest.fixture(scope='module')
def here() -> Iterator[Server]:
    with Server(ROUTES, Feed()) as server:
        yield server


@pytest.fixture(scope='module')
def anywhere() -> Iterator[Server]:
    with Server(ROUTES, Feed(), host='0.0.0.0', names=['robot.example']) as server:
        yield server


def test_a_page_answers_this_host_only_unless_told_otherwise(here: Server):
    assert here.url == f'http://127.0.0.1:{here.address.port}/'
    assert ask(here.address.port).text == 'hello'
    own = socket.gethostbyname(socket.gethostname())
    if own != '127.0.0.1' and not own.startswith('127.'):
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection((own, here.address.port), timeout=5)


@pytest.mark.parametrize(
    'host',
    ['evil.example', '', '127.0.0.1', 'localhost:1', '10.0.0.1', 'a@127.0.0.1', '[::1', '\t'],
)
def test_a_request_that_names_another_host_is_refused(here: Server, host: str):
    port = here.address.port
    named = f'{host}:{port}' if host in ('evil.example', '10.0.0.1', 'a@127.0.0.1') else host
    answer = ask(port, headers={'Host': named})
    assert (answer.status, 'hello' in answer.text) in ((421, False), (400, False))


@pytest.mark.parametrize('host', ['localhost', 'LocalHost', '127.0.0.1', '[::1]'])
def test_this_host_has_several_names(here: Server, host: str):
    port = here.address.port
    assert ask(port, headers={'Host': f'{host}:{port}'}).status == 200


@pytest.mark.parametrize(
    ('headers', 'status'),
    [
        ({'Origin': 'http://evil.example'}, 403),
        ({'Origin': 'null'}, 403),
        ({'Sec-Fetch-Site': 'cross-site', 'Sec-Fetch-Mode': 'no-cors'}, 403),
        ({'Sec-Fetch-Site': 'same-site', 'Sec-Fetch-Mode': 'cors'}, 403),
        ({'Sec-Fetch-Site': 'cross-site', 'Sec-Fetch-Mode': 'navigate'}, 200),  # a link
        ({'Sec-Fetch-Site': 'same-origin', 'Sec-Fetch-Mode': 'cors'}, 200),
    ],
)
def test_other_peoples_pages_cannot_ask(here: Server, headers: dict[str, str], status: int):
    assert ask(here.address.port, headers=headers).status == status


def test_what_is_sent_must_come_from_the_page_itself_as_json_of_a_limited_size(here: Server):
    port = here.address.port
    own = {'Origin': f'http://127.0.0.1:{port}', 'Sec-Fetch-Site': 'same-origin'}

    def post(headers: dict[str, str], body: bytes = b'{"a": 1}') -> int:
        return ask(port, '/echo', headers, 'POST', body).status

    assert post(JSON | own) == 200
    assert post(JSON) == 200  # a program, no browser
    assert post(JSON | {'Content-Type': 'application/json; charset=utf-8'}) == 200
    assert post(JSON | {'Origin': 'http://evil.example'}) == 403
    other = {'Sec-Fetch-Site': 'cross-site', 'Sec-Fetch-Mode': 'navigate'}  # a form elsewhere
    assert post(JSON | other) == 403
    for kind in ('text/plain', 'application/x-www-form-urlencoded', ''):
        assert post({'Content-Type': kind}) == 415
    assert post(JSON, b'"' + b'a' * (MOST_BYTES - 2) + b'"') == 200
    assert post(JSON, b'"' + b'a' * (MOST_BYTES - 1) + b'"') == 413


def test_every_answer_carries_the_headers_even_a_refusal(here: Server):
    port = here.address.port
    for answer in (ask(port), ask(port, '/no'), ask(port, headers={'Host': 'evil.example'})):
        for name, value in HEADERS.items():
            assert answer.headers[name.lower()] == value
        assert 'server' not in answer.headers


def test_the_policy_lets_scripts_and_styles_come_from_the_server_alone():
    policy = HEADERS['Content-Security-Policy']
    rules = dict(rule.strip().split(' ', 1) for rule in policy.split(';'))
    assert rules['default-src'] == "'none'"
    assert rules['script-src'] == rules['style-src'] == rules['connect-src'] == "'self'"
    assert rules['require-trusted-types-for'] == "'script'"
    assert 'unsafe' not in policy


def test_other_hosts_need_the_token(anywhere: Server):
    port = anywhere.address.port
    token = parse_qs(urlsplit(anywhere.url).query)['token'][0]
    assert len(token) >= 40
    for path in (
        '/',
        '/?token=',
        f'/?token={token[:-1]}',
        f'/?token={token}x',
        '/static/base.css',
    ):
        answer = ask(port, path)
        assert answer.status == 401
        assert 'hello' not in answer.text
        assert token not in answer.text
    assert ask(port, f'/?token={token}&token={token}').status == 401
    assert ask(port, '/events').status == 401
    assert ask(port, '/', {'Authorization': f'Bearer {token}'}).text == 'hello'
    assert ask(port, '/', {'Authorization': 'Bearer x'}).status == 401
    assert ask(port, '/', {'Cookie': f'codetr_{port}=x'}).status == 401
    assert ask(port, '/', {'Cookie': f'other={token}'}).status == 401
    assert ask(port, '/', {'Authorization': 'Bearer ä'}).status == 401


def test_the_token_becomes_a_cookie_and_leaves_the_address(anywhere: Server):
    port = anywhere.address.port
    token = parse_qs(urlsplit(anywhere.url).query)['token'][0]
    answer = ask(port, f'//evil.example/?token={token}')
    assert (answer.status, answer.headers['location']) == (303, '/evil.example/')
    cookie = answer.headers['set-cookie']
    assert {'HttpOnly', 'SameSite=lax', 'Path=/'} <= set(cookie.split('; '))
    assert ask(port, '/', {'Cookie': cookie.split(';')[0]}).text == 'hello'
    with Server(ROUTES, Feed(), host='0.0.0.0') as other:
        assert ask(other.address.port, '/', {'Cookie': cookie.split(';')[0]}).status == 401


def test_a_page_for_other_hosts_is_asked_by_their_names_for_it(anywhere: Server):
    port, bearer = anywhere.address.port, f'Bearer {anywhere.address.token}'
    for host in (socket.gethostname(), 'robot.example', '192.0.2.7', 'localhost'):
        headers = {'Host': f'{host}:{port}', 'Authorization': bearer}
        assert ask(port, headers=headers).status == 200
    headers = {'Host': f'evil.example:{port}', 'Authorization': bearer}
    assert ask(port, headers=headers).status == 421


@pytest.mark.parametrize(
    ('host', 'port', 'words'),
    [
        ('127.0.0.1', 70_000, '--port 70000 is no port'),
        ('no.such.host.invalid', 0, "--host 'no.such.host.invalid' is unknown here"),
        ('192.0.2.1', 0, '--host 192.0.2.1 cannot be listened to'),
    ],
)
def test_an_address_that_cannot_be_served_is_refused(host: str, port: int, words: str):
    with pytest.raises(PageError, match=words), Server(ROUTES, Feed(), host=host, port=port):
        pass


def test_a_port_that_is_taken_is_refused_with_what_to_do(here: Server):
    taken = here.address.port
    words = f'--port {taken} of 127.0.0.1 is taken: choose another'
    with pytest.raises(PageError, match=words), Server(ROUTES, Feed(), port=taken):
        pass


def test_a_port_can_be_chosen_and_is_free_again_afterwards():
    with Server(ROUTES, Feed()) as before:
        chosen = before.address.port
    with Server(ROUTES, Feed(), port=chosen) as again:
        assert again.address == Address('127.0.0.1', chosen)
        assert ask(chosen).text == 'hello'


def events(
    connection: http.client.HTTPConnection, path: str = '/events'
) -> http.client.HTTPResponse:
    connection.request('GET', path)
    answer = connection.getresponse()
    assert answer.headers['Content-Type'].startswith('text/event-stream')
    return answer


def next_event(stream: http.client.HTTPResponse) -> dict[str, str]:
    """The next event with data."""
    found: dict[str, str] = {}
    while True:
        line = stream.readline().decode()
        assert line, 'the stream has ended'
        if line == '\n':
            if 'data' in found:
                return found
            found = {}
        elif not line.startswith(':'):
            name, _, value = line.rstrip('\n').partition(': ')
            found[name] = value


def test_a_stream_begins_with_the_newest_values_and_goes_on_with_changes(feed: Feed):
    feed.publish('a', {'text': 'line\nline', 'gap': float('nan')})
    feed.publish('b', 1)
    feed.publish('b', 2)
    with Server(ROUTES, feed) as server:
        connection = http.client.HTTPConnection('127.0.0.1', server.address.port, timeout=120)
        stream = events(connection)
        first = next_event(stream)
        assert (first['event'], first['data']) == ('a', '{"text":"line\\nline","gap":null}')
        assert next_event(stream)['data'] == '2'
        feed.publish('b', 2)  # no change
        threading.Thread(target=feed.publish, args=('c', 3)).start()
        assert next_event(stream)['event'] == 'c'
        connection.close()


def test_the_server_stops_while_a_page_looks(feed: Feed):
    with Server(ROUTES, feed) as server:
        connection = http.client.HTTPConnection('127.0.0.1', server.address.port, timeout=120)
        stream = events(connection)
        feed.publish('a', 1)
        next_event(stream)
        assert feed.streams == 1
    assert stream.read() == b''
    assert feed.streams == 0
    connection.close()


def test_infinities_become_null_and_everything_is_a_line_of_json():
    value = {'a': [float('inf'), -float('inf'), 1.5], 'b': ('x', None), 3: '</script>\u2028'}
    assert to_json(value) == '{"a":[null,null,1.5],"b":["x",null],"3":"</script>\\u2028"}'


OWN = [path for path in STATIC.rglob('*') if path.suffix in ('.js', '.html', '.css')]


@pytest.mark.parametrize('path', OWN, ids=lambda path: path.name)
def test_the_pages_load_nothing_from_elsewhere_and_put_nothing_in_as_markup(path: Path):
    text = path.read_text()
    markup = r'innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\(|new Function|srcdoc'
    assert not re.search(markup, text)
    assert not re.search(r'(src|href)\s*=\s*["\']?(https?:)?//|url\(|@import', text)
    if path.suffix == '.html':
        assert not re.search(r'<script(?![^>]*\bsrc=)|\son\w+=|\sstyle=|<style', text)
        assert '<html lang="en">' in text
        assert 'name="viewport"' in text


def test_the_plotting_library_is_shipped_with_its_licence():
    assert 'Leon Sorokin' in (STATIC / 'uplot' / 'LICENSE').read_text()
    assert (STATIC / 'uplot' / 'uPlot.iife.min.js').stat().st_size > 40_000


def test_a_browser_opens_a_page_and_refuses_scripts_that_are_not_the_servers(tab, feed: Feed):
    page = '<!doctype html><script src=/static/page.js type=module></script><p id=a>x'
    with_script = page + '<script>document.body.textContent = "run"</script>'
    routes = [Route('/', lambda _: Response(with_script, media_type='text/html'))]
    with Server(routes, feed, host='0.0.0.0') as server:
        opened = tab(server.url.replace(socket.gethostname(), '127.0.0.1'))
        assert 'token' not in opened.url
        assert opened.inner_text('#a') == 'x'
        assert len(opened.errors) == 1
        assert 'Content Security Policy' in opened.errors.pop()
        evil = 'document.querySelector("#a").innerHTML = "<b>b</b>"'
        with pytest.raises(Exception, match='TrustedHTML'):
            opened.evaluate(evil)
        assert 'TrustedHTML' in opened.errors.pop()
