"""Settings as text: what the launch file hands on."""

import pytest

from codetr_ros.config import USUAL, SettingsError, from_text, load

BASE = load('quick')


def test_text_becomes_settings_of_their_types_and_what_is_empty_stays():
    given = {'task': 'Hopper-v5', 'delay': '25', 'sac.hidden': '[64, 32]', 'seed': ''}
    settings, changed = from_text(BASE, given, 'here')
    assert changed == {'task': 'Hopper-v5', 'delay': 25, 'sac.hidden': (64, 32)}
    assert (settings.task, settings.delay, settings.seed) == ('Hopper-v5', 25, BASE.seed)


def test_every_usual_setting_can_be_given_as_the_text_of_its_default():
    flat = BASE.flat()
    texts = {
        name: str(list(value) if isinstance(value, tuple) else value)
        for name in USUAL
        if (value := flat[name]) is not None
    }
    settings, _ = from_text(BASE, texts, 'here')
    assert settings == BASE


@pytest.mark.parametrize(
    ('given', 'words'),
    [
        ({'delay': '-3'}, 'here.*delay.*-3'),
        ({'sac.hidden': '[64'}, r'here: sac.hidden:=\[64'),
        ({'method': 'nothing'}, 'here.*method.*nothing'),
    ],
)
def test_what_is_refused_is_named_with_its_place(given, words):
    with pytest.raises(SettingsError, match=words):
        from_text(BASE, given, 'here')
