"""The ROS packages as a ROS installation reads them, and that they agree with the code."""

import ast
import re
import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from typing import get_args
from xml.etree import ElementTree

import pytest
from catkin_pkg.package import parse_package

import bootstrap
from codetr_ros import records
from codetr_ros.records.roles import TABLE

ROOT = Path(__file__).resolve().parents[2]
PYTHON_PACKAGES = bootstrap.PACKAGES[1:]
EXECUTABLES = {
    'codetr_ros': {'codetr', 'record', 'score'},
    'sim_node': {'sim', 'evaluate', 'robot'},
    'reward_node': {'reward'},
    'learner_node': {'learner', 'act'},
}


def keywords(package: str) -> dict[str, ast.expr]:
    """What a package's setup.py passes to setup()."""
    tree = ast.parse((ROOT / package / 'setup.py').read_text())
    call = next(
        n for n in ast.walk(tree) if isinstance(n, ast.Call) and ast.unparse(n.func) == 'setup'
    )
    return {str(k.arg): k.value for k in call.keywords}


def scripts(package: str) -> dict[str, str]:
    """Commands of a package and the functions they call."""
    entries = ast.literal_eval(keywords(package)['entry_points'])['console_scripts']
    return dict(entry.split(' = ') for entry in entries)


@pytest.mark.parametrize('package', bootstrap.PACKAGES)
def test_each_manifest_is_valid_and_of_format_3(package: str):
    warnings: list[str] = []
    manifest = parse_package(str(ROOT / package), warnings=warnings)
    assert warnings == []
    assert manifest.package_format == 3
    assert manifest.licenses == ['Apache-2.0']
    build = 'ament_cmake' if package == 'msgs' else 'ament_python'
    assert manifest.get_build_type() == build
    assert manifest.name == ('codetr_msgs' if package == 'msgs' else package)


@pytest.mark.parametrize('package', PYTHON_PACKAGES)
def test_manifest_and_setup_say_the_same(package: str):
    manifest = ElementTree.parse(ROOT / package / 'package.xml').getroot()
    said = keywords(package)
    assert manifest.find('maintainer').get('email') == ast.literal_eval(said['maintainer_email'])
    assert manifest.findtext('license') == ast.literal_eval(said['license'])


def test_all_packages_are_of_one_version_which_stands_in_their_manifests():
    versions = {
        ElementTree.parse(ROOT / package / 'package.xml').getroot().findtext('version')
        for package in bootstrap.PACKAGES
    }
    versions |= set(re.findall(r'^version: (\S+)$', (ROOT / 'CITATION.cff').read_text(), re.M))
    assert len(versions) == 1
    for package in PYTHON_PACKAGES:
        printed = subprocess.check_output(
            [sys.executable, 'setup.py', '--version'], cwd=ROOT / package, text=True
        )
        assert printed.split()[-1] in versions


@pytest.mark.parametrize('package', PYTHON_PACKAGES)
def test_ros2_run_finds_the_executables_of_each_package(package: str):
    assert set(scripts(package)) == EXECUTABLES[package]
    assert (ROOT / package / 'resource' / package).is_file()
    setup_cfg = (ROOT / package / 'setup.cfg').read_text()
    assert f'script_dir=$base/lib/{package}' in setup_cfg
    assert f'install_scripts=$base/lib/{package}' in setup_cfg


@pytest.mark.parametrize('package', PYTHON_PACKAGES)
def test_each_executable_calls_a_function_that_exists(package: str):
    for target in scripts(package).values():
        module, function = target.split(':')
        path = ROOT / package / Path(*module.split('.'))
        source = path / '__init__.py' if path.is_dir() else path.with_suffix('.py')
        tree = ast.parse(source.read_text())
        names = {n.name for n in tree.body if isinstance(n, ast.FunctionDef)}
        names |= {
            a.asname or a.name for n in tree.body if isinstance(n, ast.ImportFrom) for a in n.names
        }
        assert function in names, f'{target} is not in {source}'


def test_every_message_file_is_built():
    listed = set(
        re.findall(r'(?:msg|srv)/\w+\.(?:msg|srv)', (ROOT / 'msgs/CMakeLists.txt').read_text())
    )
    there = {str(p.relative_to(ROOT / 'msgs')) for p in (ROOT / 'msgs').glob('*/*.[ms][sr][gv]')}
    assert listed == there


@pytest.mark.parametrize('record', get_args(records.Record), ids=lambda record: record.__name__)
def test_a_record_and_its_message_have_the_same_fields_in_the_same_order(record: type):
    lines = (ROOT / 'msgs' / 'msg' / f'{record.__name__}.msg').read_text().splitlines()
    declared = [re.match(r'([\w/]+(?:\[\d*\])?) (\w+)(=?)', line) for line in lines]
    names = [found[2] for found in declared if found and not found[3]]
    own = [field.name for field in fields(record)]
    assert names == ['stamp', *own, 'sender', 'signature']


def test_every_field_of_every_message_says_what_it_is():
    for path in (ROOT / 'msgs').glob('*/*.[ms][sr][gv]'):
        lines = path.read_text().splitlines()
        assert lines[0].startswith('# '), f'{path.name} does not say what it is for'
        for line in lines:
            assert not line or line == '---' or '# ' in line, f'{path.name}: {line}'


def test_constants_of_messages_are_those_of_the_records():
    text = ''.join(path.read_text() for path in sorted((ROOT / 'msgs' / 'msg').glob('*.msg')))
    assert f'PROTOCOL_VERSION={records.PROTOCOL_VERSION} ' in text
    assert f'INITIAL_VERSION={records.INITIAL_VERSION} ' in text
    assert tuple(re.findall(r'string ROLE_\w+=(\w+)', text)) == records.ROLES


@pytest.mark.parametrize('role', records.ROLES)
def test_what_starts_a_role_is_a_command_of_its_package(role: str):
    row = TABLE[role]
    assert row.executable in scripts(row.package)


@pytest.mark.parametrize('name', [*bootstrap.REQUIREMENTS, bootstrap.WITHOUT_DEPENDENCIES])
def test_each_requirement_is_pinned_exactly_has_its_reason_and_names_no_index(name: str):
    for line in (ROOT / name).read_text().splitlines():
        if line and not line.startswith('#'):
            assert re.fullmatch(
                r"[\w-]+(\[\w+\])?==[\w.]+(; python_version (<|>=) '3\.\d+')?  # .{10,}", line
            ), f'{name}: {line}'
            assert '://' not in line


def test_the_licence_is_apache_2():
    text = (ROOT / 'LICENSE').read_text()
    assert 'Apache License' in text
    assert 'TERMS AND CONDITIONS FOR USE, REPRODUCTION, AND DISTRIBUTION' in text
