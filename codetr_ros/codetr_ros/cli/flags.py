"""Flags of the command line, made from `config.Settings` with its names, ranges and defaults.

tyro parses the fields of a dataclass. The dataclasses are made here from the settings, because
tyro would run pydantic's checks one group at a time and replace their messages by its own. So the
values are collected first and validated once, by `config.parse`.
"""

import dataclasses
from collections.abc import Collection, Sequence
from typing import Annotated, Any

import tyro
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from codetr_ros import config
from codetr_ros.cli.terminal import parse_arguments
from codetr_ros.config import Settings, SettingsError
from codetr_ros.runs.numbers import exact

_BOUNDS = {'ge': '>=', 'gt': '>', 'le': '<=', 'lt': '<'}

HELP, HELP_ALL = ('-h', '--help'), '--help-all'
HELP_ALL_FIELD = (
    'help_all',
    Annotated[
        bool,
        tyro.conf.FlagCreatePairsOff,
        tyro.conf.arg(help='show this help message with every setting and exit'),
    ],
    False,
)
"""Lists `--help-all`, on which `explained` acts."""


def _help(field: FieldInfo) -> str:
    bounds = [
        f'{sign} {exact(bound)}'
        if isinstance(bound := getattr(m, name), float)
        else f'{sign} {bound}'
        for name, sign in _BOUNDS.items()
        for m in field.metadata
        if hasattr(m, name)
    ]
    return (field.description or '') + (f' [{", ".join(bounds)}]' if bounds else '')


def settings_fields(
    group: BaseModel, only: Collection[str] | None = None, prefix: str = ''
) -> list[tuple[str, Any, Any]]:
    """Fields for `dataclasses.make_dataclass`: name, annotated type, default from `group`.

    Args:
        group: the settings.
        only: dotted names of the settings that get a field; None: all.
        prefix: of the dotted names of this group.
    """
    fields: list[tuple[str, Any, Any]] = []
    for name, field in type(group).model_fields.items():
        value = getattr(group, name)
        dotted = f'{prefix}{name}'
        text = tyro.conf.arg(help=_help(field))
        if isinstance(value, BaseModel):
            inner = settings_fields(value, only, f'{dotted}.')
            if not inner:
                continue
            nested = dataclasses.make_dataclass(type(value).__name__, inner, frozen=True)
            nested.__doc__ = field.description
            default = dataclasses.field(default_factory=nested)
            fields.append((name, Annotated[nested, text], default))
        elif only is None or dotted in only:
            fields.append(
                (name, Annotated[field.annotation, text], dataclasses.field(default=value))
            )
    return fields


def explained(
    arguments: Sequence[str], base: Settings, description: str, left_out: Collection[str] = ()
) -> tuple[list[str], list[tuple[str, Any, Any]], str]:
    """The settings as flags: all of them, but for `--help`, which explains the common ones alone.

    Args:
        arguments: the command's arguments.
        base: the settings whose values are the defaults.
        description: what the command does.
        left_out: settings, and groups of them, that the command does not take.

    Returns:
        The arguments for the parser, with `--help` for `--help-all`; the fields of the settings;
        and the description, which names `--help-all` where it is needed.
    """
    fields = [field for field in settings_fields(base) if field[0] not in left_out]
    if HELP_ALL in arguments:
        return [HELP[1]], fields, description
    if not any(argument in HELP for argument in arguments):
        return list(arguments), fields, description
    common = [field for field in settings_fields(base, config.USUAL) if field[0] not in left_out]
    note = f'The settings below are those that people change most; {HELP_ALL} explains all.'
    return [HELP[1]], common, f'{description}\n\n{note}'


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
        description: what it does, for its help.
        default: the configuration whose values are the defaults, unless `--config` names another.
        more: further fields (name, annotated type, `dataclasses.field`), shown before the
            settings.

    Returns:
        The settings, and the values of `more` by name.

    Raises:
        SettingsError: a value is out of range, or the configuration cannot be read.
        SystemExit: code 0 after `--help` or `--help-all`, 2 for a flag that does not exist or a
            value of the wrong type.
    """
    name = chosen_config(arguments, default)
    base = config.load(name)
    text = f'{", ".join(config.PRESETS)} or a YAML file: the defaults of all other flags'
    own = [
        HELP_ALL_FIELD,
        ('config', Annotated[str, tyro.conf.arg(metavar='NAME|FILE', help=text)], name),
        *more,
    ]
    given, fields, description = explained(arguments, base, description)
    kind = dataclasses.make_dataclass('Arguments', [*own, *fields], frozen=True)
    kind.__doc__ = description
    values = dataclasses.asdict(
        parse_arguments(kind, prog=prog, description=description, arguments=given)
    )
    extra = {field[0]: values.pop(field[0]) for field in own}
    settings = config.parse(values, 'command line')
    return settings, extra
