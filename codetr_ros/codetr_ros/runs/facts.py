"""What a run writes about itself: fields with descriptions, whose types are checked on reading."""

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args

from pydantic import BaseModel, BeforeValidator, ConfigDict, ValidationError

from codetr_ros.config import explain
from codetr_ros.runs.folder import RunFolderError


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
"""How many of each: of messages by topic, or of whatever has the name."""


class Facts(BaseModel):
    """Base of what is written: immutable, every number finite.

    A field that is not known here is passed over: a later version of the program may have written
    it. A field that is lacking is refused, unless it has a default.
    """

    model_config = ConfigDict(extra='ignore', frozen=True, allow_inf_nan=False)


_F = TypeVar('_F', bound=Facts)


def read(kind: type[_F], path: Path, what: str, remedy: str) -> _F:
    """Read what a run has written into a file.

    Args:
        kind: what it holds.
        path: the file.
        what: a name for it, for the error.
        remedy: what to do where it is refused, for the error.

    Raises:
        RunFolderError: it cannot be read, is not a JSON object, or lacks a field or has one of
            another type; names the file and the field.
    """
    try:
        data = json.loads(path.read_text())
    except OSError as error:
        raise RunFolderError(
            f'{what} {path} cannot be read ({error.strerror}): {remedy}'
        ) from None
    except ValueError as error:
        raise RunFolderError(f'{what} {path} is not JSON ({error}): {remedy}') from None
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
        name: as it is reached: `messages.*.lost` is `lost` of each entry of `messages`,
            `evaluations[].step` is `step` of each row of `evaluations`.
        description: what it is, with its unit.
    """

    name: str
    description: str


def described(kind: type[Facts], prefix: str = '') -> Iterator[Described]:
    """All fields, those of rows and entries after the field that holds them."""
    for name, field in kind.model_fields.items():
        yield Described(name=prefix + name, description=field.description or '')
        inner, place = _inner(field.annotation)
        if inner is not None:
            yield from described(inner, f'{prefix}{name}{place}.')


def _inner(annotation: Any) -> tuple[type[Facts] | None, str]:
    """The facts that a field holds one or many of, and how one of them is reached."""
    if isinstance(annotation, type) and issubclass(annotation, Facts):
        return annotation, ''
    origin = getattr(annotation, '__origin__', None)
    place = '[]' if origin is list else '.*' if origin is dict else ''
    for part in get_args(annotation):
        inner, deeper = _inner(part)
        if inner is not None:
            return inner, place + deeper
    return None, ''
