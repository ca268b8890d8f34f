"""What setup.cfg allows and what the requirements files pin are the same packages."""

import configparser
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import bootstrap

ROOT = Path(__file__).resolve().parents[2]
FILES = {
    'requirements.txt': '',
    'requirements-ros.txt': 'ros',
    'requirements-ray.txt': 'ray',
    'requirements-test.txt': 'test',
    'requirements-docs.txt': 'docs',
}
"""Each file of pins and the extra of the package that it serves; '' for what is always needed."""
PYTHONS = ('3.10', '3.11', '3.12', '3.13')


def needed(requirements: list[str], python: str) -> dict[str, Requirement]:
    """Those that count for a version of Python, by package, each named once only."""
    parsed = [Requirement(line) for line in requirements]
    counted = [r for r in parsed if not r.marker or r.marker.evaluate({'python_version': python})]
    by_name = {canonicalize_name(r.name): r for r in counted}
    assert len(by_name) == len(counted), f'a package is named twice for Python {python}'
    return by_name


def pinned(file: str, python: str) -> dict[str, Requirement]:
    """What a requirements file pins."""
    lines = [line.partition('  #')[0] for line in (ROOT / file).read_text().splitlines()]
    return needed([line for line in lines if line and not line.startswith('#')], python)


def declared(extra: str, python: str) -> dict[str, Requirement]:
    """What the package asks for."""
    parser = configparser.ConfigParser()
    parser.read(ROOT / 'codetr_ros' / 'setup.cfg')
    text = (
        parser['options.extras_require'][extra] if extra else parser['options']['install_requires']
    )
    return needed(text.split('\n')[1:], python)


def test_every_file_that_the_set_up_installs_belongs_to_an_extra_of_the_package():
    parser = configparser.ConfigParser()
    parser.read(ROOT / 'codetr_ros' / 'setup.cfg')
    assert set(FILES) == set(bootstrap.REQUIREMENTS)
    assert set(FILES.values()) - {''} == set(parser['options.extras_require'])


@pytest.mark.parametrize('python', PYTHONS)
@pytest.mark.parametrize('file', FILES)
def test_pins_and_package_name_the_same_packages_and_each_pin_is_allowed(file: str, python: str):
    pins, ranges = pinned(file, python), declared(FILES[file], python)
    assert pins.keys() == ranges.keys()
    for name, pin in pins.items():
        (version,) = pin.specifier
        assert ranges[name].specifier.contains(version.version), f'{pin} is not {ranges[name]}'
        assert pin.extras == ranges[name].extras


def test_what_is_installed_without_dependencies_is_what_other_pythons_install_with_them():
    for name, pin in pinned(bootstrap.WITHOUT_DEPENDENCIES, '3.13').items():
        assert pin.specifier == pinned('requirements.txt', '3.12')[name].specifier
