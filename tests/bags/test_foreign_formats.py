"""What a file declares about its messages decides how they are read, and whether they are."""

import re
import sqlite3
import sys
from pathlib import Path

import pytest
from mcap.reader import make_reader

from codetr_ros.bags.errors import BagError
from codetr_ros.bags.reader import Bag
from codetr_ros.bags.recover import recover
from codetr_ros.bags.schemas import Definition, parsed, types_of
from codetr_ros.bags.topics import schema_text
from codetr_ros.bags.verify import verify
from codetr_ros.cli import main
from helpers.arm import attempt, bag, files_of, mcap_file
from helpers.bags import WRITERS, a_run

SHARE = Path(sys.prefix) / 'share'
POINTER = 'version https://git-lfs.github.com/spec/v1\noid sha256:' + '0' * 64 + '\nsize 12345\n'


def test_messages_that_are_no_cdr_are_not_read_as_cdr(tmp_path):
    file = mcap_file(tmp_path / 'x.mcap', attempt(3), encoding='json')
    with pytest.raises(BagError, match="of /joint_states are serialised as 'json': only cdr"):
        list(Bag(file).messages(topics=['/joint_states']))
    assert sum(1 for _ in Bag(file).raw()) == 7, 'as bytes they are read'


def test_records_of_ours_that_are_no_cdr_are_refused_too(tmp_path):
    made = WRITERS['rosbags-sqlite-9'](tmp_path / 'bag', a_run())
    (file,) = files_of(made)
    with sqlite3.connect(file) as database:
        database.execute("UPDATE topics SET serialization_format = 'xml'")
    database.close()
    with pytest.raises(BagError, match="serialised as 'xml': only cdr is read"):
        list(Bag(made).entries())
    assert verify(made).findings.counts['record']


def test_a_recovered_bag_declares_what_the_old_one_declared(tmp_path):
    file = mcap_file(tmp_path / 'x.mcap', attempt(3), encoding='json')
    recover(file, tmp_path / 'new')
    (new,) = files_of(tmp_path / 'new')
    with new.open('rb') as opened:
        channels = make_reader(opened).get_summary().channels.values()
    assert {channel.message_encoding for channel in channels} == {'json'}
    assert 'serialization_format: json' in (tmp_path / 'new' / 'metadata.yaml').read_text()


def test_metadata_of_another_serialisation_than_the_file_is_found(tmp_path):
    made = bag(tmp_path / 'bag', attempt(3))
    text = (made / 'metadata.yaml').read_text()
    (made / 'metadata.yaml').write_text(
        text.replace('serialization_format: cdr', 'serialization_format: xml')
    )
    found = [finding.text for finding in verify(made).findings.named]
    assert any("/cmd is serialised as 'xml', its file states 'cdr'" in text for text in found)


def idl_of(package: str, name: str) -> str:
    """A definition as rosbag2 writes it where it has no .msg file: each IDL file, of the type and
    of what it includes, behind a line of = and a heading.
    """
    todo, seen, text = [(package, name)], set(), ''
    while todo:
        key = todo.pop(0)
        if key not in seen:
            seen.add(key)
            body = (SHARE / key[0] / 'msg' / f'{key[1]}.idl').read_text()
            text += f'{"=" * 80}\nIDL: {key[0]}/msg/{key[1]}\n{body}\n'
            todo += re.findall(r'#include "(\w+)/msg/(\w+)\.idl"', body)
    return text


@pytest.mark.parametrize(
    'name',
    [
        'sensor_msgs/msg/BatteryState',
        'trajectory_msgs/msg/JointTrajectory',
        'nav_msgs/msg/Odometry',
        'std_msgs/msg/Float64MultiArray',
        'shape_msgs/msg/SolidPrimitive',
        'codetr_msgs/msg/Transitions',
    ],
)
def test_an_idl_definition_gives_the_same_fields_as_the_msg_definition(name):
    package, _, short = name.split('/')
    if not (SHARE / package / 'msg' / f'{short}.idl').exists():
        pytest.skip(f'{package} is not installed')
    by_idl = parsed(name, Definition('ros2idl', idl_of(package, short)))
    by_msg = parsed(name, Definition('ros2msg', schema_text(name).decode()))
    assert {kind: fields for kind, (_, fields) in by_idl.items()} == {
        kind: fields for kind, (_, fields) in by_msg.items()
    }


@pytest.mark.parametrize('encoding', ['ros2idl', 'ros2msg'])
def test_a_definition_that_cannot_be_read_is_refused_on_one_line(encoding):
    with pytest.raises(BagError, match='the definition of a/msg/B cannot be read: ') as refused:
        types_of('a/msg/B', Definition(encoding, 'float64 x\n\n]] y\n'))
    assert '\n' not in str(refused.value)


def test_messages_of_no_type_are_refused():
    with pytest.raises(BagError, match='does not state of what type its messages are'):
        types_of('', Definition('', ''))


def test_an_idl_definition_may_contain_types_defined_by_msg_files():
    text = (
        f'{"=" * 80}\nIDL: pkg/msg/Arm\n#include "pkg/msg/Part.idl"\n'
        'module pkg { module msg { struct Arm { pkg::msg::Part part; }; }; };\n'
        f'{"=" * 80}\nMSG: pkg/Part\nfloat64[3] q\n'
    )
    types = parsed('pkg/msg/Arm', Definition('ros2idl', text))
    assert sorted(types) == ['pkg/msg/Arm', 'pkg/msg/Part']


@pytest.mark.parametrize('suffix', ['mcap', 'db3', 'mcap.zstd'])
@pytest.mark.parametrize('folder', [False, True])
def test_a_git_lfs_pointer_is_named_as_one(tmp_path, capsys, suffix, folder):
    file = tmp_path / 'bag' / f'bag_0.{suffix}'
    file.parent.mkdir()
    file.write_text(POINTER)
    given = str(file.parent if folder else file)
    for command in (['info', given], ['verify', given], ['recover', given, '--out', given + '_']):
        assert main(['bag', *command]) == 2
        assert f'bag_0.{suffix} is a Git LFS pointer, not the file' in capsys.readouterr().err


def test_metadata_that_is_a_git_lfs_pointer_is_named_as_one(tmp_path):
    made = bag(tmp_path / 'bag', attempt(3))
    (made / 'metadata.yaml').write_text(POINTER)
    with pytest.raises(BagError, match=r'metadata.yaml is a Git LFS pointer.*git lfs pull'):
        Bag(made)
