"""Links between the pages of the repository lead somewhere, as a code host shows them."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted(
    page
    for pattern in ('*.md', 'docs/**/*.md', 'benchmarks/**/*.md', 'examples/**/*.md')
    for page in ROOT.glob(pattern)
)
CODE = re.compile(r'^( *)```.*?^\1```|`[^`\n]*`', re.MULTILINE | re.DOTALL)
LINK = re.compile(r'\]\((?P<target>[^)\s#]*)(?:#(?P<anchor>[^)\s]*))?\)')


def anchors(page: Path) -> set[str]:
    """What GitHub makes of the headings of a page."""
    text = re.sub(r'^( *)```.*?^\1```', '', page.read_text(), flags=re.MULTILINE | re.DOTALL)
    found: set[str] = set()
    for heading in re.findall(r'^#{1,6} +(.+?) *$', text, re.MULTILINE):
        plain = re.sub(r'\[([^\]]*)\]\([^)]*\)', r'\1', heading).replace('`', '').lower()
        slug = re.sub(r'[^\w\- ]', '', plain).replace(' ', '-')
        again = sum(1 for each in found if re.fullmatch(rf'{re.escape(slug)}(-\d+)?', each))
        found.add(f'{slug}-{again}' if again else slug)
    return found


@pytest.mark.parametrize('page', PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_of_a_page_leads_somewhere(page: Path):
    broken = []
    for match in LINK.finditer(CODE.sub('', page.read_text())):
        target, anchor = match['target'], match['anchor']
        if re.match(r'[a-z]+:', target):
            continue
        there = (page.parent / target).resolve() if target else page
        if not there.exists():
            broken.append(f'{target}: there is no such file')
        elif anchor and there.suffix == '.md' and anchor not in anchors(there):
            broken.append(f'{target}#{anchor}: there is no such heading')
    assert not broken


def test_no_page_is_an_island():
    """Every page of docs/ is in the site's navigation, which MkDocs checks, or among decisions."""
    navigation = (ROOT / 'mkdocs.yml').read_text()
    decisions = (ROOT / 'docs/decisions/index.md').read_text()
    for page in (ROOT / 'docs').rglob('*.md'):
        listed = decisions if page.parent.name == 'decisions' else navigation
        assert page.name == 'index.md' or page.name in listed, page
