"""What `--help` and `--help-all` of the commands that take settings explain."""

import re
from pathlib import Path

import pytest

from codetr_ros import cli, config
from codetr_ros.config import USUAL
from codetr_ros.offline.settings import OF_NO_EFFECT, FitSettings

DOCS = Path(__file__).parents[2] / 'docs'
EVERY = set(config.load('quick').flat())
OWN = {
    'train': {'help_all', 'config', 'out', 'in_process'},
    'fit': {'help_all', 'config', 'out', 'run', 'checkpoint'},
}


def explained(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *arguments: str
) -> tuple[set[str], str]:
    """The names of the flags that a command's help explains, as settings have them; and all of
    its text.
    """
    monkeypatch.setenv('COLUMNS', '100')  # one column of flags
    with pytest.raises(SystemExit) as left:
        cli.main(list(arguments))
    assert left.value.code == 0
    shown = capsys.readouterr().out
    flags = re.findall(r'^[│ ] (?:-h, )?--([a-z_.-]+)', shown, re.M)
    return {flag.replace('-', '_') for flag in flags} - {'help'}, ' '.join(shown.split())


def test_twenty_settings_are_those_that_people_use() -> None:
    assert len(USUAL) == len(set(USUAL)) == 20
    assert set(USUAL) <= EVERY


def test_the_help_of_train_explains_the_common_settings_and_names_the_flag_that_explains_all(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    names, text = explained(capsys, monkeypatch, 'train', '--help')

    assert names & EVERY == set(USUAL)
    assert OWN['train'] <= names
    assert '--help-all explains all' in text
    assert explained(capsys, monkeypatch, 'train', '-h')[0] == names


def test_help_all_of_train_explains_every_setting(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    names, _ = explained(capsys, monkeypatch, 'train', '--help-all')
    common, _ = explained(capsys, monkeypatch, 'train', '--help')

    assert names & EVERY == EVERY
    assert names - EVERY == common - EVERY, 'the same flags of its own'


def test_the_help_of_fit_explains_what_a_fit_uses(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    used = {name for name in EVERY if name.partition('.')[0] not in OF_NO_EFFECT}
    fitting = set(FitSettings.model_fields)

    common, text = explained(capsys, monkeypatch, 'fit', '--help')
    assert common & EVERY - fitting == used & set(USUAL) - fitting
    assert fitting | OWN['fit'] <= common
    assert '--help-all explains all' in text

    names, _ = explained(capsys, monkeypatch, 'fit', '--help-all')
    assert names & EVERY - fitting == used - fitting


def test_help_shows_the_defaults_of_the_chosen_config(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for flag in ('--help', '--help-all'):
        _, text = explained(capsys, monkeypatch, 'train', '--config', 'paper', flag)
        assert '(default: Ant-v4)' in text


@pytest.mark.parametrize('page', ['command-line.md', 'settings.md', 'getting-started.md'])
def test_the_pages_name_both_helps(page: str) -> None:
    text = (DOCS / page).read_text()

    assert '--help`' in text
    assert '--help-all`' in text
