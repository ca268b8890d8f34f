"""The base of all settings: how they are validated, and what a refusal names."""

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic_core import ErrorDetails

from codetr_ros.system.parsing import shortened
from codetr_ros.system.similar import did_you_mean

_IN_WORDS: dict[str, str] = {}


def in_words(pattern: str, words: str) -> str:
    """A regular expression for a setting; a refusal then explains it in words.

    Args:
        pattern: the regular expression.
        words: what it allows, to follow 'must be'.
    """
    _IN_WORDS[pattern] = words
    return pattern


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


@dataclass(frozen=True)
class Whole:
    """The bounds of a setting where it is a whole number, for people."""

    ge: int
    le: int


def flatten(data: Mapping[str, Any], prefix: str = '') -> Iterator[tuple[str, Any]]:
    """The values of nested mappings, each with its dotted name."""
    for key, value in data.items():
        if isinstance(value, Mapping):
            yield from flatten(value, f'{prefix}{key}.')
        else:
            yield f'{prefix}{key}', value


_LINES = 20  # of a refusal
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
        raise SettingsError(explain(error, source, names(kind))) from None


def names(kind: type[BaseModel], prefix: str = '') -> Iterator[str]:
    """The dotted names of all settings of a group."""
    for name, field in kind.model_fields.items():
        # a group may be left out: X | None
        kinds = (field.annotation, *get_args(field.annotation))
        inner = [k for k in kinds if isinstance(k, type) and issubclass(k, BaseModel)]
        for each in inner:
            yield from names(each, f'{prefix}{name}.')
        if not inner:
            yield prefix + name


def _reason(refusal: ErrorDetails, name: str, known: Iterable[str]) -> str:
    """Why a value was refused, for people."""
    if refusal['type'] in ('extra_forbidden', 'invalid_key'):  # a key that is no text is no name
        return f'there is no such setting{did_you_mean(name, known)}'
    context = refusal.get('ctx', {})
    if words := _IN_WORDS.get(context.get('pattern', '')):
        return f'must be {words}'
    if refusal['type'] == 'literal_error' and isinstance(refusal['input'], str):
        choices = re.findall(r"'([^']*)'", context['expected'])
        return f'{refusal["msg"]}{did_you_mean(refusal["input"], choices)}'
    return refusal['msg'].removeprefix('Value error, ')


def explain(error: ValidationError, source: str, known: Iterable[str] = ()) -> str:
    """The refusals of pydantic, a line for each value: its source, name, value and the reason.

    Args:
        error: the refusals.
        source: where the values came from.
        known: the names that there are, of which one may be meant by a name that is unknown.
    """
    there = list(known)
    lines = []
    errors = error.errors()
    for e in errors[:_LINES]:
        name = '.'.join(str(part) for part in e['loc'])
        bare = e['type'] == 'invalid_key' or isinstance(e['input'], Mapping)
        shown = '' if bare else f' = {shortened(repr(e["input"]))}'
        given = f'{shortened(name)}{shown}: ' if name else ''  # else it is about several values
        lines.append(f'{source}: {given}{_reason(e, name, there)}')
    if len(errors) > _LINES:
        lines.append(f'{source}: and {len(errors) - _LINES} more')
    return '\n'.join(lines)
