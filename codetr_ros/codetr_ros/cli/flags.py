"""Flags of the command line, made from `config.Settings` with its names, ranges and defaults.

tyro parses the fields of a dataclass. The dataclasses are made here from the settings, because
tyro would run pydantic's checks one group at a time and replace their messages by its own. So the
values are collected first and validated once, by `config.parse`.
"""

import dataclasses
from collections.abc import Sequence
from typing import Annotated, Any

import tyro
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from codetr_ros import config
from codetr_ros.config import Settings, SettingsError

_BOUNDS = {'ge': '>=', 'gt': '>', 'le': '<=', 'lt': '<'}


def _help(field: FieldInfo) -> str:
    bounds = [
        f'{sign} {bound:g}' if isinstance(bound := getattr(m, name), float) else f'{sign} {bound}'
        for name, sign in _BOUNDS.items()
        for m in field.metadata
        if hasattr(m, name)
    ]
    return (field.description or '') + (f' [{", ".join(bounds)}]' if bounds else '')


def settings_fields(group: BaseModel) -> list[tuple[str, Any, Any]]:
    """Fields for `dataclasses.make_dataclass`: name, annotated type, default from `group`."""
    fields: list[tuple[str, Any, Any]] = []
    for name, field in type(group).model_fields.items():
        value = getattr(group, name)
        text = tyro.conf.arg(help=_help(field))
        if isinstance(value, BaseModel):
            nested = dataclasses.make_dataclass(
                type(value).__name__, settings_fields(value), frozen=True
            )
            nested.__doc__ = field.description
            default = dataclasses.field(default_factory=nested)
            fields.append((name, Annotated[nested, text], default))
        else:
            fields.append(
                (name, Annotated[field.annotation, text], dataclasses.field(default=value))
            )
    return fields


def chosen_config(arguments: Sequence[str], default: str) -> str:
    """The value of the last `--config`, which sets the defaults of all other flags.

    Raises:
        SettingsError: `--config` is the last argument.
    """
    chosen = default
    for i, argument in enumerate(arguments):
        if argument == '--config':
            if i + 1 == len(arguments):
                raise SettingsError(
                    f'--config needs a value: {", ".join(config.PRESETS)} or a YAML file'
                )
            chosen = arguments[i + 1]
        elif argument.startswith('--config='):
            chosen = argument.removeprefix('--config=')
    return chosen


def parse(
    arguments: Sequence[str],
    prog: str,
    description: str,
    default: str,
    more: Sequence[tuple[str, Any, Any]] = (),
) -> tuple[Settings, dict[str, Any]]:
    """Parse a command line that takes every setting as a flag.

    Args:
        arguments: the command's arguments.
        prog: its name.
        description: what it does, for `--help`.
        default: the configuration whose values are the defaults, unless `--config` names another.
        more: further fields (name, annotated type, `dataclasses.field`), shown before the
            settings.

    Returns:
        The settings, and the values of `more` by name.

    Raises:
        SettingsError: a value is out of range, or the configuration cannot be read.
        SystemExit: code 0 after `--help`, 2 for a flag that does not exist or a value of the wrong
            type.
    """
    name = chosen_config(arguments, default)
    base = config.load(name)
    text = f'{", ".join(config.PRESETS)} or a YAML file: the defaults of all other flags'
    own = [
        ('config', Annotated[str, tyro.conf.arg(metavar='NAME|FILE', help=text)], name),
        *more,
    ]
    kind = dataclasses.make_dataclass('Arguments', [*own, *settings_fields(base)], frozen=True)
    kind.__doc__ = description
    values = dataclasses.asdict(tyro.cli(kind, prog=prog, description=description, args=arguments))
    extra = {field[0]: values.pop(field[0]) for field in own}
    settings = config.parse(values, 'command line')
    return settings, extra
