"""The facts that a run writes about itself: fields with descriptions, checked on reading."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args

from pydantic import BaseModel, BeforeValidator, ConfigDict, ValidationError

from codetr_ros.config import explain
from codetr_ros.runs.folder import RunFolderError
from codetr_ros.system.parsing import ParseError, read_json


def finite(value: Any) -> Any:
    """The same value with None for each number that JSON cannot hold (NaN, infinities)."""
    if isinstance(value, Mapping):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


Number = Annotated[float | None, BeforeValidator(finite)]
"""A finite number; None where it is not known, not defined or not finite."""

Counts = dict[str, int]
"""Counts by name: of messages by topic, or of anything else."""


class Facts(BaseModel):
    """Base of the facts: immutable, every number finite.

    An unknown field is ignored, because a later version of the program may have written it. A
    missing field is refused unless it has a default.
    """

    model_config = ConfigDict(extra='ignore', frozen=True, allow_inf_nan=False)


_F = TypeVar('_F', bound=Facts)


def read(kind: type[_F], path: Path, what: str, remedy: str) -> _F:
    """Read the facts that a run has written into a file.

    Args:
        kind: the kind of facts.
        path: the file.
        what: a name for the file, for the error.
        remedy: what to do if it is refused, for the error.

    Raises:
        RunFolderError: it cannot be read, is not a JSON object, lacks a field or has one of
            another type; names the file and the field.
    """
    try:
        data = read_json(path)
    except OSError as error:
        raise RunFolderError(
            f'{what} {path} cannot be read ({error.strerror}): {remedy}'
        ) from None
    except ParseError as error:
        raise RunFolderError(f'{what} {path} {error}: {remedy}') from None
    if not isinstance(data, dict):
        raise RunFolderError(f'{what} {path} holds {type(data).__name__}, not an object: {remedy}')
    try:
        return kind.model_validate(data)
    except ValidationError as error:
        raise RunFolderError(f'{explain(error, f"{what} {path}")}: {remedy}') from None


@dataclass(frozen=True, kw_only=True)
class Described:
    """A field, for people.

    Attributes:
        name: its path: `messages.*.lost` is `lost` of each entry of `messages`,
            `evaluations[].step` is `step` of each row of `evaluations`.
        description: what it is, with its unit.
    """

    name: str
    description: str


def described(kind: type[Facts], prefix: str = '') -> Iterator[Described]:
    """All fields; those of rows and entries follow the field that holds them."""
    for name, field in kind.model_fields.items():
        yield Described(name=prefix + name, description=field.description or '')
        inner, place = _inner(field.annotation)
        if inner is not None:
            yield from described(inner, f'{prefix}{name}{place}.')


def _inner(annotation: Any) -> tuple[type[Facts] | None, str]:
    """The kind of facts that a field holds, one or many, and the path to one of them."""
    if isinstance(annotation, type) and issubclass(annotation, Facts):
        return annotation, ''
    origin = getattr(annotation, '__origin__', None)
    place = '[]' if origin is list else '.*' if origin is dict else ''
    for part in get_args(annotation):
        inner, deeper = _inner(part)
        if inner is not None:
            return inner, place + deeper
    return None, ''
