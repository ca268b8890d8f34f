"""What makes a site of these pages (MkDocs runs it, see mkdocs.yml).

The pages have two kinds of readers. On a code host their links lead to files of the repository;
in the site the same links must lead somewhere too. So every file outside of docs/ that a page
links to becomes a page of the site, below source/: Markdown and pictures as they are, everything
else as numbered lines. A link whose text names a symbol (`rewards/codetr.py::Codetr.predict`)
leads to its line.

It also adds the API reference, a page for each module of the library.
"""

import ast
import posixpath
import re
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parent.parent
LIBRARY = 'codetr_ros/codetr_ros'
"""The package, below the root."""
LINK = re.compile(
    r'(?P<before>!?\[(?:[^\[\]]|\[[^\]]*\])*\]\()(?P<target>[^)\s#]+)(?P<anchor>#[^)\s]*)?\)'
)
SYMBOL = re.compile(
    r'<a href="(?P<page>[^"#]+)"><code>(?P<path>[\w/]+\.py)::(?P<name>[\w.]+)</code></a>'
)
METHOD = re.compile(r'docs/methods\.md#(?P<anchor>[\w-]+)')
FENCE = re.compile(r'^( *)(`{3,})(?!.*`).*?^\1\2`*$', re.MULTILINE | re.DOTALL)
LANGUAGES = {
    '.py': 'python',
    '.yaml': 'yaml',
    '.yml': 'yaml',
    '.xml': 'xml',
    '.toml': 'toml',
}
PICTURES = {'.png', '.svg'}


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Fill in the navigation of decisions and API reference."""
    decisions = sorted((ROOT / 'docs/decisions').glob('[0-9]*.md'))
    made: dict[str, list[Any]] = {
        'decisions/': ['decisions/index.md', *(f'decisions/{page.name}' for page in decisions)],
        'reference/': reference_navigation(),
    }
    config.nav = filled(config.nav, made)
    return config


def filled(entry: Any, made: dict[str, list[Any]]) -> Any:
    """A part of the navigation, with what is made here in the place of its folder."""
    if isinstance(entry, list):
        return [filled(each, made) for each in entry]
    if isinstance(entry, dict):
        return {title: filled(each, made) for title, each in entry.items()}
    return made.get(entry, entry)


def modules() -> Iterator[PurePosixPath]:
    """Every module of the library by its path below it, a folder's own (`__init__`) first."""
    library = ROOT / LIBRARY
    for path in sorted(library.rglob('*.py')):
        yield PurePosixPath(path.relative_to(library).as_posix())


def module_name(path: PurePosixPath) -> str:
    """The dotted name of a module."""
    parts = path.with_suffix('').parts
    return '.'.join(('codetr_ros', *(part for part in parts if part != '__init__')))


def reference_page(path: PurePosixPath) -> str:
    """Where the reference of a module lies."""
    page = path.with_name('index.md') if path.stem == '__init__' else path.with_suffix('.md')
    return f'reference/{page}'


def reference_navigation() -> list[Any]:
    """A section for each folder, a page for each module."""
    top: list[Any] = []
    folders: dict[PurePosixPath, list[Any]] = {PurePosixPath('.'): top}
    for path in modules():
        if path.parent not in folders:
            folders[path.parent] = []
            parent = folders.setdefault(path.parent.parent, [])
            parent.append({f'{path.parent.name}/': folders[path.parent]})
        page = reference_page(path)
        folders[path.parent].append(page if path.stem == '__init__' else {path.stem: page})
    return top


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the API reference, and the files outside of docs/ that pages lead to."""
    for module in modules():
        name = module_name(module)
        files.append(
            File.generated(config, reference_page(module), content=f'# `{name}`\n\n::: {name}\n')
        )
    waiting = [
        (f'docs/{file.src_uri}', file.content_string) for file in files.documentation_pages()
    ]
    added: set[str] = set()
    while waiting:
        page, text = waiting.pop()
        for target in outside_targets(text, page):
            if target in added:
                continue
            added.add(target)
            path = ROOT / target
            if path.suffix in PICTURES:
                content: str | bytes = path.read_bytes()
            else:
                content = source_page(target)
                if target.endswith('.md') or path.is_dir():
                    waiting.append((source_of(target), content))
            files.append(File.generated(config, site_path(target), content=content))
    return files


def source_of(target: str) -> str:
    """The file whose links are meant where `target` is shown: a folder's is its README."""
    return posixpath.join(target, 'README.md') if (ROOT / target).is_dir() else target


def outside_targets(text: str, page: str) -> Iterator[str]:
    """Files outside of docs/, by their paths below the root, that a page's links lead to."""
    for match in LINK.finditer(FENCE.sub('', text)):
        target = repository_path(match['target'], page)
        if target and not is_page(target) and (ROOT / target).exists():
            yield target


def is_page(target: str) -> bool:
    """Whether a path below the root is a page or a picture of the site as it is."""
    return target.startswith('docs/') and not target.endswith('.py')


def repository_path(target: str, page: str) -> str | None:
    """What a relative link of a page leads to, below the root; None for addresses."""
    if re.match(r'[a-z]+:', target):
        return None
    return posixpath.normpath(posixpath.join(posixpath.dirname(page), target))


def site_path(target: str) -> str:
    """Where a file or folder of the repository lies in the site's sources."""
    if is_page(target):
        return target.removeprefix('docs/')
    path = ROOT / target
    if path.is_dir():
        return f'source/{target}/index.md'
    if path.name == 'README.md':
        return f'source/{posixpath.dirname(target)}/index.md'.replace('//', '/')
    if path.suffix in {'.md', *PICTURES}:
        return f'source/{target}'
    return f'source/{target}.md'


def source_page(target: str) -> str:
    """A page that shows a file or folder of the repository."""
    path = ROOT / target
    head = '---\nsearch: {exclude: true}\n---\n\n'
    if path.is_dir() and not (path / 'README.md').exists():
        names = sorted(p.name for p in path.iterdir() if p.is_file())
        return f'{head}# `{target}/`\n\n' + ''.join(f'- [`{name}`]({name})\n' for name in names)
    text = (path / 'README.md' if path.is_dir() else path).read_text()
    if target.endswith('.md') or path.is_dir():
        return head + text
    fence = '`' * 8
    language = LANGUAGES.get(path.suffix, 'text')
    return f'{head}# `{target}`\n\n{fence} {language} linenums="1"\n{text}\n{fence}\n'


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Lead links that leave docs/ to the pages that show what they mean."""
    here = page.file.src_uri
    if here.startswith('source/'):
        mine = here.removeprefix('source/')
        mine = mine.replace('index.md', 'README.md') if mine.endswith('index.md') else mine
    else:
        mine = f'docs/{here}'

    def lead(match: re.Match[str]) -> str:
        target = repository_path(match['target'], mine)
        if target is None or not (ROOT / target).exists():
            return match[0]  # MkDocs refuses it
        if is_page(mine) and is_page(target) and not (ROOT / target).is_dir():
            return match[0]
        there = posixpath.relpath(site_path(target), posixpath.dirname(here) or '.')
        return f'{match["before"]}{there}{match["anchor"] or ""})'

    kept: list[str] = []

    def keep(match: re.Match[str]) -> str:
        kept.append(match[0])
        return f'\0{len(kept) - 1}\0'

    led = LINK.sub(lead, FENCE.sub(keep, markdown))
    return re.sub('\0(\\d+)\0', lambda match: kept[int(match[1])], led)


def on_page_content(html: str, page: Page, **_: Any) -> str:
    """Lead links that name a symbol to its line, and docstrings to the section that they name."""

    def to_line(match: re.Match[str]) -> str:
        line = line_of(f'{LIBRARY}/{match["path"]}', match['name'])
        return match[0].replace(match['page'], f'{match["page"]}#__codelineno-0-{line}')

    html = SYMBOL.sub(to_line, html)
    if page.file.src_uri.startswith('reference/'):
        there = posixpath.relpath('methods.html', posixpath.dirname(page.file.dest_uri))
        html = METHOD.sub(rf'<a href="{there}#\g<anchor>">\g<0></a>', html)
    return html


def line_of(path: str, symbol: str) -> int:
    """The line of a class, function or constant (`Codetr.predict`) in a file below the root.

    Raises:
        KeyError: there is no such symbol in it.
    """
    body: list[ast.stmt] = ast.parse((ROOT / path).read_text()).body
    line = 0
    for name in symbol.split('.'):
        for node in body:
            if name in names_of(node):
                line, body = node.lineno, getattr(node, 'body', [])
                break
        else:
            raise KeyError(f'{path} has no {symbol}')
    return line


def names_of(node: ast.stmt) -> list[str]:
    """What a statement defines."""
    if isinstance(node, (ast.ClassDef, ast.FunctionDef)):
        return [node.name]
    if isinstance(node, ast.Assign):
        return [target.id for target in node.targets if isinstance(target, ast.Name)]
    if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
        return [node.target.id]
    return []
