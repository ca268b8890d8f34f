"""No YAML and no JSON takes the process down, eats its memory, or fails otherwise than by name."""

import json
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from codetr_ros import cli, config
from codetr_ros.bags.errors import BagError
from codetr_ros.bags.files import listed_files
from codetr_ros.benchmark import spec
from codetr_ros.benchmark.spec import BenchmarkError
from codetr_ros.config import SettingsError
from codetr_ros.robots import mapping
from codetr_ros.runs import folder, run_summary
from codetr_ros.runs.folder import RunFolderError
from codetr_ros.system import parsing
from codetr_ros.system.parsing import ParseError, parse_json, parse_yaml

BOMB = 'a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n' + ''.join(
    f'a{i}: &a{i} [{", ".join([f"*a{i - 1}"] * 10)}]\n' for i in range(1, 9)
)
BAD_YAML = {
    'brackets': ('[' * 40_000, 'is nested too deeply: at most 64'),
    'closed brackets': ('[' * 5000 + ']' * 5000, 'is nested too deeply'),
    'braces': ('{a: ' * 5000, 'is nested too deeply'),
    'dashes': ('- ' * 5000 + 'x', 'is nested too deeply'),
    'keys': ('? ' * 5000, 'is nested too deeply'),
    'an alias bomb': (BOMB, 'has aliases that stand for more than 10000 values .line 4'),
    'a list in itself': ('a: &a [*a]', r'is not YAML: \*a names nothing before it'),
    'an alias of nothing': ('a: *b', r'is not YAML: \*b names nothing before it'),
    'latin': ('a: caf\xe9'.encode('latin-1'), r"is not UTF-8 text .byte 6 is b'\\xe9'.: save it"),
    'a nul': ('a: \0', 'is not YAML: .*control characters'),
    'decimals': ('a: ' + '9' * 5000, r'has an integer of 5000 digits .line 1'),
    'hexadecimals': ('\na: 0x' + 'f' * 5000, r'has an integer of 5002 digits .line 2'),
    '65 bits': ('a: [1, 18446744073709551616]', r'has an integer of more than 64 bits in a\[1\]'),
    'a long key': ('9' * 30 + ': 1', 'has an integer of more than 64 bits'),
    'octals': ('a: !!int 089', 'is not YAML: the value in line 1 is none of its kind'),
    'an empty integer': ("a: !!int ''", 'is not YAML: the value in line 1 is none of its kind'),
    'a false date': ('a: 2024-13-45', r'is none of its kind .month must be in 1..12'),
    'an object': ('a: !!python/object/apply:os.system [ls]', 'could not determine a constructor'),
    'a key twice': ('a: 1\nb: 2\na: 3', "has the key 'a' twice in one mapping .line 3"),
    'a list as a key': ('[1]: 2', 'is not YAML: .*unhashable key'),
    'two texts': ('a: 1\n---\na: 2', 'is not YAML: expected a single document'),
    'a long text': ('a: ' + 'x' * parsing.LONGEST_YAML, 'has more than 1048576 bytes'),
}
MOST_SHOWN = 600  # characters of an error


@pytest.mark.parametrize(('text', 'expected'), BAD_YAML.values(), ids=BAD_YAML.keys())
def test_yaml_that_cannot_be_used_is_refused_in_a_sentence(text, expected):
    with pytest.raises(ParseError, match=expected) as refused:
        parse_yaml(text)
    assert len(str(refused.value)) < MOST_SHOWN


@pytest.mark.parametrize(
    'text',
    [
        'a: {b: [1, 2.5, null, true, "x"], c: 2024-01-02}',
        'base: &b {x: 1}\nother: {<<: *b, y: 2}\nthird: *b',
        'a: {x: 1}\nb: {x: 1}\nc: [{x: 1}, {x: 1}]',
        '[' * 60 + ']' * 60,
        'a: 18446744073709551615',
        'x: café',
        'a: "' + '9' * 5000 + '"',
        '',
        *(p.read_text() for p in Path(config.__file__).parent.joinpath('presets').glob('*.yaml')),
    ],
)
def test_yaml_that_can_be_used_is_read_as_pyyaml_reads_it(text):
    expected = yaml.safe_load(text)
    assert parse_yaml(text) == expected
    assert parse_yaml(text.encode()) == expected
    assert parse_yaml(b'\xef\xbb\xbf' + text.encode()) == expected
    assert parse_yaml(text.encode('utf-16')) == expected


def test_numbers_with_colons_are_text_and_none_of_base_sixty():
    text = 'a: 10:50\nb: [1:2:3.5, 59' + ':59' * 300 + ']'
    assert parse_yaml(text) == {'a': '10:50', 'b': ['1:2:3.5', '59' + ':59' * 300]}


def test_a_key_may_stand_twice_where_nobody_writes_by_hand():
    assert parse_yaml('a: 1\na: 2', unique=False) == {'a': 2}


BAD_JSON = {
    'brackets': ('[' * 100_000, 'is nested too deeply'),
    'closed brackets': ('[' * 100 + ']' * 100, 'is nested too deeply'),
    'decimals': ('9' * 5000, 'has an integer of 5000 digits'),
    '65 bits': ('{"a": [0, 18446744073709551616]}', r'an integer of more than 64 bits in a\[1\]'),
    'latin': (b'"\xe9"', 'is not UTF-8 text'),
    'half': ('{"a": 1', 'is not JSON: Expecting'),
}


@pytest.mark.parametrize(('text', 'expected'), BAD_JSON.values(), ids=BAD_JSON.keys())
def test_json_that_cannot_be_used_is_refused_in_a_sentence(text, expected):
    with pytest.raises(ParseError, match=expected) as refused:
        parse_json(text)
    assert len(str(refused.value)) < MOST_SHOWN


def test_json_that_can_be_used_is_read_as_python_reads_it():
    text = json.dumps({'a': [1, -2.5e-7, None, True, 'é'], 'b': {'c': 2**64 - 1}})
    assert parse_json(text) == parse_json(text.encode()) == json.loads(text)


# ------------------------------------------------------------------------------------------
# every text that is read


def _metadata(path: Path) -> None:
    path.rename(path.parent / 'metadata.yaml')
    listed_files(path.parent)


READERS: dict[str, tuple[Callable[[Path], Any], type[Exception]]] = {
    'config': (lambda path: config.load(str(path)), SettingsError),
    'mapping': (mapping.load, SettingsError),
    'spec': (spec.load, BenchmarkError),
    'metadata': (_metadata, BagError),
}


@pytest.mark.parametrize('reader', READERS)
@pytest.mark.parametrize('kind', [k for k in BAD_YAML if k not in ('a long text', 'a key twice')])
def test_every_yaml_file_is_read_with_the_same_limits(tmp_path, reader, kind):
    read, error = READERS[reader]
    text, expected = BAD_YAML[kind]
    path = tmp_path / 'read.yaml'
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(error, match=expected) as refused:
        read(path)
    assert str(tmp_path) in str(refused.value)
    assert len(str(refused.value)) < MOST_SHOWN


@pytest.mark.parametrize('kind', BAD_JSON)
def test_settings_and_summaries_are_read_with_the_same_limits(tmp_path, kind):
    text, expected = BAD_JSON[kind]
    if isinstance(text, str):
        with pytest.raises(SettingsError, match=expected):
            config.from_canonical(text, 'checkpoint')
    path = tmp_path / folder.SUMMARY
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(RunFolderError, match=expected):
        run_summary.read(path)


def test_a_value_without_end_is_shown_in_part():
    with pytest.raises(SettingsError, match='delay = .xxx') as refused:
        config.parse({'delay': 'x' * 100_000}, 'test')
    assert len(str(refused.value)) < MOST_SHOWN
    with pytest.raises(SettingsError, match='and 980 more') as refused:
        config.parse({f'x{i}': 1 for i in range(1000)}, 'test')
    assert len(str(refused.value).splitlines()) == 21


def test_a_file_that_fails_to_be_read_is_named():
    with pytest.raises(SettingsError, match='config /proc/self/mem cannot be read: Input/output'):
        config.load('/proc/self/mem')


@pytest.mark.parametrize('kind', ['brackets', 'an alias bomb', 'latin', 'decimals'])
def test_verify_reports_metadata_that_cannot_be_read(tmp_path, kind, capsys):
    from helpers.foreign_bags import write

    bag = write(tmp_path / 'bag', [])
    text, expected = BAD_YAML[kind]
    content = text if isinstance(text, bytes) else text.encode()
    (bag / 'metadata.yaml').write_bytes(content)
    assert cli.main(['bag', 'verify', str(bag)]) != 0
    said = capsys.readouterr()
    assert expected.split(':')[0].split('.')[0] in ' '.join((said.out + said.err).split())


@pytest.mark.slow
def test_an_alias_bomb_takes_no_memory(tmp_path):
    path = tmp_path / 'bomb.yaml'
    path.write_text(BOMB)
    limited = (
        'import sys; from codetr_ros import cli; '
        "sys.exit(cli.main(['convert', 'none', '--mapping', sys.argv[1], '--out', 'none']))"
    )
    done = subprocess.run(
        [sys.executable, '-c', limited, str(path)],
        check=False,
        capture_output=True,
        text=True,
        timeout=120,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_DATA, (1 << 30, 1 << 30)),
    )
    assert done.returncode == 2, done.stderr
    assert 'has aliases that stand for more than' in done.stderr
