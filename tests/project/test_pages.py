"""What the pages say agrees with the program: commands, flags, parameters, topics, settings."""

import contextlib
import importlib.util
import io
import re
import shlex
from functools import cache
from pathlib import Path

import pytest
import yaml

from codetr_ros.cli import COMMANDS, main
from codetr_ros.config import load
from codetr_ros.processes import launcher
from codetr_ros.records import TOPICS
from codetr_ros.records.roles import TABLE

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', *sorted((ROOT / 'docs').rglob('*.md'))]
GROUPS = {'bag': ('info', 'verify', 'recover', 'play'), 'benchmark': ('run', 'report')}
ROS = importlib.util.find_spec('rclpy') is not None


def commands(text: str) -> list[str]:
    """Commands of a page: lines of its code blocks, and code within its sentences."""
    blocks = re.findall(r'^```(?:bash|sh)?\n(.*?)^```', text, re.MULTILINE | re.DOTALL)
    lines = [line for block in blocks for line in block.splitlines()]
    lines += re.findall(r'^ {4,6}(\S.*)$', text, re.MULTILINE)
    lines += re.findall(r'`([^`\n]+)`', text)
    return [line.split(' # ')[0].split('   ')[0].strip() for line in lines]


QUOTED = [(page, command) for page in PAGES for command in commands(page.read_text())]


@cache
def help_of(*command: str) -> str:
    written = io.StringIO()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv('COLUMNS', '300')  # nothing is wrapped
        with contextlib.redirect_stdout(written), contextlib.suppress(SystemExit):
            main([*command, '--help-all' if command[0] in ('train', 'fit') else '--help'])
    return written.getvalue()


def check_codetr(words: list[str]) -> None:
    """Refuse a command or flag that does not exist."""
    assert words, 'a command'
    known = words[0] in COMMANDS
    assert known or words[0].isupper() or words[0].startswith('-'), words
    if not known:
        return
    command = words[:1]
    if words[0] in GROUPS and len(words) > 1:
        command = words[:2]
        assert words[1].strip(',') in GROUPS[words[0]], words
    for flag in re.findall(r'(?<![\w-])--[a-z][\w.-]*', ' '.join(words[1:])):
        assert re.search(rf'(?<![\w-]){re.escape(flag)}(?![\w-])', help_of(*command)), (
            command,
            flag,
        )


def test_the_commands_that_pages_quote_exist_with_their_flags():
    seen = 0
    for page, command in QUOTED:
        match = re.match(r'(?:\.venv/bin/)?codetr (.+)', command)
        if match:
            words = shlex.split(match[1].replace("'", '').replace('"', ''))
            try:
                check_codetr([word.strip('[]') for word in words])
            except AssertionError as error:
                raise AssertionError(f'{page.name}: {command}') from error
            seen += 1
    assert seen > 30


def test_a_flag_that_a_page_names_by_itself_is_a_flag_of_some_command():
    names = [
        (name, *word) for name in COMMANDS for word in [(w,) for w in GROUPS.get(name, [])] or [()]
    ]
    known = ' '.join(help_of(*name) for name in names)
    seen = 0
    for page, command in QUOTED:
        if match := re.match(r'(--[a-z][\w.-]*)(?= |$)', command):
            assert re.search(rf'(?<![\w-]){re.escape(match[1])}(?![\w-])', known), (page, command)
            seen += 1
    assert seen > 30


def test_the_flags_that_pages_pass_to_make_train_exist():
    seen = 0
    for _, command in QUOTED:
        if match := re.match(r"make train ARGS='(.+)'", command):
            if match[1] != '...':
                check_codetr(['train', *shlex.split(match[1])])
            seen += 1
    assert seen > 3


def test_the_targets_of_make_that_pages_name_exist():
    makefile = (ROOT / 'Makefile').read_text()
    targets = set(re.findall(r'^(\w+):', makefile, re.MULTILINE))
    named = {match[1] for _, command in QUOTED if (match := re.match(r'make (\w+)', command))}
    assert named
    assert named <= targets


def test_the_page_of_settings_is_what_the_settings_say():
    spec = importlib.util.spec_from_file_location('settings_page', ROOT / 'docs/settings_page.py')
    assert spec
    assert spec.loader
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    page = (ROOT / 'docs/settings.md').read_text()
    assert page == made.page(), 'run: python docs/settings_page.py'


def test_every_setting_is_on_the_page_of_settings_with_its_default():
    page = (ROOT / 'docs/settings.md').read_text()
    for name in load('paper').flat():
        assert f'| `{name}` |' in page


@pytest.mark.skipif(not ROS, reason='rclpy is missing')
def test_the_page_on_ros_names_every_topic_with_its_type_and_depth():
    from codetr_ros.ros import qos

    rows = dict(re.findall(r'^\| `(\w+)` \| (`\w+` \|.*)$', ros_section('Topics'), re.MULTILINE))
    assert set(rows) == set(TOPICS.values())
    for kind, topic in TOPICS.items():
        cells = [cell.strip() for cell in rows[topic].strip(' |').split('|')]
        assert cells[0] == f'`{kind.__name__}`'
        late = 'yes' if qos.QUALITIES[topic].transient_local else ''
        assert cells[-2:] == [late, str(qos.depth(topic, load('quick')))], topic


@pytest.mark.skipif(not ROS, reason='rclpy is missing')
def test_the_page_on_ros_names_every_parameter_of_the_nodes_with_its_default():
    from codetr_ros.ros.own_parameters import WITHOUT_RUN, own_parameters

    roles = {'learner': 'learner', 'reward': 'reward', 'record': 'recorder', 'sim': ''}
    roles |= {'robot': 'robot', 'act': 'act'}
    rows = re.findall(
        r'^\| (\w+) \| `(\w+)` \| (.*?) ?\|', ros_section('Parameters'), re.MULTILINE
    )
    said = {(node, name): default.strip().strip('`') for node, name, default in rows}
    shared = set(own_parameters('sim'))
    expected = {}
    for role, node in roles.items():
        for name, own in own_parameters(role).items():
            default = (
                str(own.default).lower() if isinstance(own.default, bool) else str(own.default)
            )
            everybodys = name in shared and role not in WITHOUT_RUN
            expected['all' if everybodys else node, name] = default
    assert said == expected


def ros_section(title: str) -> str:
    text = (ROOT / 'docs/ros.md').read_text()
    match = re.search(rf'^## {title}\n(.*?)(?=^## |\Z)', text, re.MULTILINE | re.DOTALL)
    assert match
    return match[1]


def test_the_nodes_and_parameters_that_pages_start_exist():
    known = {(role.package, role.executable) for role in TABLE.values()}
    known |= {('sim_node', launcher.ROBOT_NODE)}  # in place of a simulator
    known |= {('learner_node', 'act')}  # no part of a run
    settings = set(load('paper').flat())
    own = {'run_id', 'folder', 'peer_deadline', 'config', 'checkpoint', 'frozen'}
    own |= {
        'bag',
        'bag_split_mb',
        'bag_keep_free_mb',
        'leave_out_after',
        'mapping',
        'autostart',
        'real_time',
    }
    for page, command in QUOTED:
        if match := re.match(r'ros2 run (\w+) (\w+)', command):
            assert (match[1], match[2]) in known, (page, command)
            assert set(re.findall(r'-p ([\w.]+):=', command)) <= settings | own, (page, command)


def test_the_layers_on_the_page_are_those_that_imports_are_held_to():
    project = (ROOT / 'pyproject.toml').read_text()
    match = re.search(r'^layers = \[(.*?)^\]', project, re.MULTILINE | re.DOTALL)
    assert match
    held = [set(re.findall(r'\w+', row)) for row in re.findall(r"'(.*)'", match[1])]
    page = (ROOT / 'docs/architecture.md').read_text()
    rows = re.findall(r'^\| \d \| (.*?) \|', page, re.MULTILINE)
    shown = [{name.removesuffix('.py') for name in re.findall(r'`([\w.]+)`', row)} for row in rows]
    assert shown == held


def quoted_yaml(page: str, tmp_path: Path) -> tuple[Path, list[str]]:
    """A file of the first YAML that a page shows, and the other YAML that it shows."""
    text, *more = re.findall(r'```yaml\n(.*?)```', (ROOT / page).read_text(), re.DOTALL)
    file = tmp_path / 'quoted.yaml'
    file.write_text(text)
    return file, more


def test_the_spec_and_the_mapping_that_pages_show_are_accepted(tmp_path: Path):
    from codetr_ros.benchmark import spec
    from codetr_ros.robots import mapping

    assert len(spec.load(quoted_yaml('docs/benchmarks.md', tmp_path)[0]).cells) == 4 * 2 * 3
    file, more = quoted_yaml('docs/other-peoples-data.md', tmp_path)
    assert mapping.load(file).source == 'arm'
    whole = yaml.safe_load(file.read_text())
    parts = [part for text in more for part in yaml.safe_load_all(text)]
    assert len(parts) >= 5
    for part in parts:
        file.write_text(yaml.safe_dump(whole | part))
        assert mapping.load(file).score.of == part['score'].get('of', 'since_last')


def test_the_mapping_that_the_page_on_live_robots_shows_is_accepted(tmp_path: Path):
    from codetr_ros.robots import mapping

    shown = mapping.load(quoted_yaml('docs/your-robot.md', tmp_path)[0])
    used = mapping.load(ROOT / 'examples/robot_arm/live.yaml')
    assert shown.live is not None
    assert used.live is not None
    assert shown.live.size(shown.action.low, shown.action.high, 0) == 2
    shown_parts = shown.live.model_fields_set
    assert shown_parts == set(type(shown.live).model_fields)  # each entry is explained
    assert (used.live.rate, used.live.command) == (shown.live.rate, shown.live.command)


def test_the_readme_is_one_page():
    readme = (ROOT / 'README.md').read_text()
    assert len(readme.splitlines()) <= 150
    for needed in ('make train', 'make test', 'docs/pictures/nodes.svg', 'docs/limits.md'):
        assert needed in readme


def test_the_citation_names_the_paper_and_the_version():
    citation = yaml.safe_load((ROOT / 'CITATION.cff').read_text())
    assert citation['cff-version'] == '1.2.0'
    assert {'message', 'title', 'authors', 'license'} <= set(citation)
    package = (ROOT / 'codetr_ros/package.xml').read_text()
    assert f'<version>{citation["version"]}</version>' in package
    (paper,) = citation['references']
    assert 'Non-Markovian' in paper['title']
    assert '2410.20176' in paper['url']


def test_security_reports_go_to_the_maintainers_of_the_package():
    package = (ROOT / 'codetr_ros/package.xml').read_text()
    match = re.search(r'email="([^"]+)"', package)
    assert match
    assert match[1] in (ROOT / 'SECURITY.md').read_text()
