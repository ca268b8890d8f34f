"""The pages as a site: no warning, nothing from the network, no link that leads nowhere."""

import re
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import pytest

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.slow


class Html(HTMLParser):
    """The ids, the links and what is fetched of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.ids: set[str] = set()
        self.links: list[str] = []
        self.fetched: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value for name, value in attrs if value}
        self.ids |= {given[name] for name in ('id', 'name') if name in given}
        if tag == 'a' and 'href' in given:
            self.links.append(given['href'])
        elif tag in ('link', 'script', 'img', 'iframe', 'source'):
            self.fetched += [given[name] for name in ('href', 'src') if name in given]


@pytest.fixture(scope='module')
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('site')
    command = [sys.executable, '-m', 'mkdocs', 'build', '--strict', '--quiet', '-d', str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.fixture(scope='module')
def pages(site: Path) -> dict[Path, Html]:
    return {page: Html(page.read_text()) for page in site.rglob('*.html')}


def test_the_site_asks_the_network_for_nothing(pages: dict[Path, Html], site: Path):
    away = {
        url for page in pages.values() for url in page.fetched if re.match(r'(https?:)?//', url)
    }
    assert away == set()
    styles = ''.join(style.read_text() for style in site.rglob('*.css'))
    assert not re.search(r'url\(["\']?https?:|@import', styles)


def leading_nowhere(pages: dict[Path, Html]) -> Iterator[str]:
    for page, html in pages.items():
        if page.name == '404.html':  # its links begin at the root of whatever serves it
            continue
        for link in html.links:
            if re.match(r'[a-z]+:|//', link):
                continue
            target, _, anchor = link.partition('#')
            there = (page.parent / unquote(target)).resolve() if target else page
            if not there.is_file():
                yield f'{page.name}: {link}: no such file'
            elif anchor and there in pages and unquote(anchor) not in pages[there].ids:
                yield f'{page.name}: {link}: no such anchor'


def test_every_link_of_the_site_leads_somewhere(pages: dict[Path, Html]):
    assert list(leading_nowhere(pages)) == []


def test_every_module_of_the_library_has_its_reference(site: Path):
    library = ROOT / 'codetr_ros/codetr_ros'
    for module in library.rglob('*.py'):
        path = module.relative_to(library)
        page = (
            path.with_name('index.html') if path.stem == '__init__' else path.with_suffix('.html')
        )
        assert (site / 'reference' / page).is_file(), path


def test_a_symbol_that_a_page_names_is_in_the_line_that_its_link_leads_to(site: Path):
    methods = (site / 'methods.html').read_text()
    found = re.findall(
        r'href="([^"#]+)#(__codelineno-0-\d+)"><code>[\w/]+\.py::([\w.]+)</code>', methods
    )
    assert len(found) == methods.count('.py::')
    for page, anchor, symbol in found:
        name = symbol.split('.')[-1]
        line = (site / page).read_text().split(f'id="{anchor}"')[1].split('\n')[0]
        assert name in re.sub(r'<[^>]*>', '', line), (page, anchor, symbol)
