"""The base of all settings: how they are validated, and what a refusal names."""

from collections.abc import Iterator, Mapping
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError


class SettingsError(ValueError):
    """A setting that is unknown or out of range: the message names it, its value and what is
    allowed.
    """


class Group(BaseModel):
    """Base of all settings: immutable. Unknown fields are refused, and values are never converted
    silently.
    """

    model_config = ConfigDict(
        extra='forbid', frozen=True, validate_default=True, allow_inf_nan=False
    )


def flatten(data: Mapping[str, Any], prefix: str = '') -> Iterator[tuple[str, Any]]:
    """The values of nested mappings, each with its dotted name."""
    for key, value in data.items():
        if isinstance(value, Mapping):
            yield from flatten(value, f'{prefix}{key}.')
        else:
            yield f'{prefix}{key}', value


_G = TypeVar('_G', bound=Group)


def validate(kind: type[_G], data: Any, source: str) -> _G:
    """Validate a group of settings that came from outside.

    Args:
        kind: the group.
        data: nested mapping of settings; a missing setting keeps its default.
        source: where they came from (a file, a node, the command line), for the error.

    Raises:
        SettingsError: names every offending setting, its value and what is allowed.
    """
    try:
        return kind.model_validate(data)
    except ValidationError as error:
        raise SettingsError(explain(error, source)) from None


def explain(error: ValidationError, source: str) -> str:
    """The refusals of pydantic, a line for each value: its source, name, value and the reason."""
    lines = []
    for e in error.errors():
        name = '.'.join(str(part) for part in e['loc']) or 'settings'
        value = '' if isinstance(e['input'], Mapping) else f' = {e["input"]!r}'
        reason = 'there is no such setting' if e['type'] == 'extra_forbidden' else e['msg']
        lines.append(f'{source}: {name}{value}: {reason}')
    return '\n'.join(lines)
