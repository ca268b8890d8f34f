"""Settings from a preset, a YAML file, or the JSON of a run."""

from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

from codetr_ros.config.base import SettingsError, flatten, validate
from codetr_ros.config.run import Settings
from codetr_ros.config.threads import AUTO
from codetr_ros.system.parsing import ParseError, parse_json, parse_yaml, read_yaml
from codetr_ros.system.similar import did_you_mean

PRESETS = ('quick', 'cpu', 'paper')


def parse(data: Mapping[str, Any], source: str) -> Settings:
    """Validate settings that came from outside.

    Args:
        data: nested mapping of settings; a missing setting keeps its default.
        source: where they came from (a file, a node, the command line), for the error.

    Raises:
        SettingsError: names every offending setting, its value and what is allowed.
    """
    return validate(Settings, data, source)


def load(name: str) -> Settings:
    """Settings of a preset (`quick`, `cpu`, `paper`) or of a YAML file.

    Raises:
        SettingsError: there is no such preset or file, it is not YAML, or a setting is refused.
    """
    if name in PRESETS:
        source = f'preset {name}'
        preset = resources.files('codetr_ros.config.presets').joinpath(f'{name}.yaml')
        data = parse_yaml(preset.read_bytes())
    else:
        path, source = Path(name), name
        if not path.is_file():
            raise SettingsError(
                f'config {name!r} is neither a preset ({", ".join(PRESETS)}) nor a file'
                f'{did_you_mean(name, PRESETS)}'
            )
        try:
            data = read_yaml(path)
        except OSError as error:
            raise SettingsError(f'config {path} cannot be read: {error.strerror}') from None
        except ParseError as error:
            raise SettingsError(f'{path} {error}') from None
    if not isinstance(data, Mapping):
        raise SettingsError(f'{source} must hold a mapping of settings, not {type(data).__name__}')
    return parse(data, source)


def differences(settings: Mapping[str, Any], preset: str) -> list[tuple[str, Any, Any]]:
    """Settings that differ from those of a preset: dotted name, value there, value here.

    Args:
        settings: nested mapping, as JSON has it; it may be of an earlier version of the program.
        preset: name of the preset. A setting that it does not know is None there; threads that it
            leaves to the machine differ from no number.
    """
    there = dict(flatten(load(preset).model_dump(mode='json')))
    return [
        (name, there.get(name), value)
        for name, value in flatten(settings)
        if name not in there or (value != there[name] and (name, there[name]) != ('threads', AUTO))
    ]


def nearest(settings: Mapping[str, Any]) -> str:
    """The preset from which fewest settings differ."""
    return min(PRESETS, key=lambda preset: len(differences(settings, preset)))


def from_canonical(text: str, source: str) -> Settings:
    """Settings from the JSON of a `RunSpec`.

    Raises:
        SettingsError: it is not JSON, or a setting is refused.
    """
    try:
        data = parse_json(text)
    except ParseError as error:
        raise SettingsError(f'{source}: the text of the settings {error}') from None
    return parse(data, source)
