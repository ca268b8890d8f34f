"""The page on methods and the code that computes them name each other."""

import importlib
import inspect
import re
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]
LIBRARY = ROOT / 'codetr_ros/codetr_ros'
PAGE = (ROOT / 'docs/methods.md').read_text()
SECTIONS = {
    title.lower().replace(' ', '-'): text
    for title, text in re.findall(r'^## (.+?)\n(.*?)(?=^## |\Z)', PAGE, re.MULTILINE | re.DOTALL)
}
NAMED = [
    (section, target, path, symbol)
    for section, text in SECTIONS.items()
    for path, symbol, target in re.findall(r'\[`([\w/]+\.py)::([\w.]+)`\]\(([^)]+)\)', text)
]


def module_of(path: str) -> ModuleType:
    return importlib.import_module('codetr_ros.' + path.removesuffix('.py').replace('/', '.'))


def resolve(path: str, symbol: str) -> object:
    found: object = module_of(path)
    for name in symbol.split('.'):
        found = getattr(found, name)
    return found


@pytest.mark.parametrize(('section', 'target', 'path', 'symbol'), NAMED)
def test_a_section_names_symbols_that_exist_in_the_file_that_it_links_to(
    section: str, target: str, path: str, symbol: str
):
    resolve(path, symbol)
    assert (ROOT / 'docs' / target).resolve() == LIBRARY / path


@pytest.mark.parametrize(('section', 'target', 'path', 'symbol'), NAMED)
def test_the_code_that_a_section_names_names_the_section(
    section: str, target: str, path: str, symbol: str
):
    own = inspect.getdoc(resolve(path, symbol)) or ''
    assert f'docs/methods.md#{section}' in own + (module_of(path).__doc__ or '')


def test_every_section_that_the_code_names_exists_and_names_that_code():
    for path in LIBRARY.rglob('*.py'):
        for section in re.findall(r'docs/methods\.md#([\w-]+)', path.read_text()):
            there = {name for each, _, name, _ in NAMED if each == section}
            assert path.relative_to(LIBRARY).as_posix() in there, (path, section)


def test_every_section_names_the_code_that_computes_it():
    assert set(SECTIONS) == {section for section, *_ in NAMED}


def test_every_method_that_can_be_chosen_has_its_place_on_the_page():
    from typing import get_args

    from codetr_ros.config import Settings

    for method in get_args(Settings.model_fields['method'].annotation):
        assert method in SECTIONS or f'| `{method}` |' in SECTIONS['fixed-rules'], method
    for composite in get_args(Settings.model_fields['composite'].annotation):
        assert f'| `{composite}` |' in SECTIONS['composite-rewards'], composite
