"""YAML and JSON from outside, read with limits: no text may take the process down, or all memory.

Python's readers recurse at each bracket (the C ones until the stack overflows), follow aliases
that make a small text endless, and fail with a dozen kinds of exceptions. Here every text that
cannot be used is a `ParseError`, whose message continues a sentence that begins with the name of
the text.
"""

import codecs
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

LONGEST_YAML = 1 << 20
"""The most bytes of a YAML text, if nothing else is asked for."""
LONGEST_JSON = 64 << 20
DEEPEST = 64
"""The most lists and mappings within each other."""
MOST_REPEATED = 10_000
"""The most values that the aliases of a YAML text may stand for."""
LARGEST_INTEGER = (1 << 64) - 1

_FAULTS = (ValueError, LookupError, TypeError, AttributeError, OverflowError)
"""What PyYAML raises for values that do not fit their tags, such as `!!int ''`."""
_INTEGER = re.compile(r'[-+]?(0x[0-9a-fA-F_]+|0b[01_]+|[0-9][0-9_]*)')
_SEXAGESIMAL = re.compile(r'[-+]?[0-9][0-9_]*(:[0-9]+)+(\.[0-9_]*)?')
_SHOWN = 200  # characters of a value or of another library's message
_DIGITS = 100
_PART = 1 << 16  # bytes


_SafeLoader: Any = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)  # the same in C, much faster


class ParseError(ValueError):
    """A text that is not what it should be, or is beyond a limit: the message continues a sentence
    that begins with the name of the text.
    """


class _Loader(_SafeLoader):  # type: ignore[misc]
    """Reads `10:50` as text, where YAML 1.1 has a number of base 60; names the line of a value
    that does not fit its tag.
    """

    def resolve(self, kind: Any, value: Any, implicit: Any) -> Any:
        """The tag of a node."""
        if kind is yaml.ScalarNode and implicit[0] and _SEXAGESIMAL.fullmatch(value):
            return 'tag:yaml.org,2002:str'
        return super().resolve(kind, value, implicit)

    def construct_object(self, node: Any, deep: bool = False) -> Any:
        """The value of a node."""
        try:
            return super().construct_object(node, deep)
        except (yaml.YAMLError, ParseError):
            raise
        except _FAULTS as error:
            raise ParseError(
                f'is not YAML: the value in line {node.start_mark.line + 1} is none of its kind '
                f'({brief(error)})'
            ) from None


def read_yaml(path: Path, longest: int = LONGEST_YAML, unique: bool = True) -> Any:
    """The content of a YAML file.

    Args:
        path: the file.
        longest: the most bytes.
        unique: whether to refuse a key that a mapping has twice.

    Raises:
        ParseError: it is not YAML, or beyond a limit.
        OSError: it cannot be read.
    """
    return parse_yaml(_content(path, longest), longest, unique)


def parse_yaml(text: bytes | str, longest: int = LONGEST_YAML, unique: bool = True) -> Any:
    """The content of a YAML text; the arguments are those of `read_yaml`.

    Raises:
        ParseError: it is not YAML, or beyond a limit.
    """
    text = _decoded(text, longest)
    try:
        _check_events(text, unique)
        content = yaml.load(text, _Loader)
    except (yaml.YAMLError, RecursionError) as error:
        raise ParseError(f'is not YAML: {brief(error)}') from None
    check_values(content)
    return content


def read_json(path: Path, longest: int = LONGEST_JSON) -> Any:
    """The content of a JSON file.

    Raises:
        ParseError: it is not JSON, or beyond a limit.
        OSError: it cannot be read.
    """
    return parse_json(_content(path, longest), longest)


def parse_json(text: bytes | str, longest: int = LONGEST_JSON) -> Any:
    """The content of a JSON text of at most `longest` bytes.

    Raises:
        ParseError: it is not JSON, or beyond a limit.
    """
    text = _decoded(text, longest)
    try:
        content = json.loads(text, parse_int=_integer)
    except ParseError:
        raise
    except RecursionError:
        raise ParseError(_too_deep()) from None
    except ValueError as error:
        raise ParseError(f'is not JSON: {brief(error)}') from None
    check_values(content)
    return content


def check_values(content: Any) -> None:
    """Check depth and integers of what was parsed.

    Raises:
        ParseError: it is nested too deeply, or an integer has more than 64 bits.
    """
    left: list[tuple[str, int, Any]] = [('', 0, content)]
    while left:
        name, depth, value = left.pop()
        if isinstance(value, int) and abs(value) > LARGEST_INTEGER:
            raise ParseError(f'has an integer of more than 64 bits{f" in {name}" if name else ""}')
        if isinstance(value, dict | list | tuple | set):
            if depth >= DEEPEST:
                raise ParseError(_too_deep())
            left += ((inner, depth + 1, one) for inner, one in _parts(name, value))


def brief(error: Exception) -> str:
    """A message of another library, on one line and not endless."""
    if isinstance(error, KeyError):
        return shortened(f'there is no {error}')
    return shortened(' '.join(str(error).split()) or type(error).__name__)


def shortened(text: str) -> str:
    """A text that is not endless."""
    return text if len(text) <= _SHOWN else f'{text[:_SHOWN]}...'


def _parts(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        for key, one in value.items():
            inner = str(key)[:_SHOWN]
            yield (f'{name}.{inner}' if name else inner), key
            yield (f'{name}.{inner}' if name else inner), one
    else:
        yield from ((f'{name}[{i}]', one) for i, one in enumerate(value))


def _content(path: Path, longest: int) -> bytes:
    """What a file holds, or a little more than the most that may be read of it."""
    parts, length = [], 0
    with path.open('rb') as file:
        while length <= longest and (part := file.read(_PART)):
            parts.append(part)
            length += len(part)
    return b''.join(parts)


def _decoded(text: bytes | str, longest: int) -> str:
    """The text, where it is not too long."""
    if len(text) > longest:
        raise ParseError(f'has more than {longest} bytes, which is the most that is read')
    if isinstance(text, str):
        return text
    utf_16 = text.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    try:
        return text.decode('utf-16' if utf_16 else 'utf-8-sig')
    except UnicodeDecodeError as error:
        raise ParseError(
            f'is not UTF-8 text (byte {error.start} is {text[error.start : error.start + 1]!r}): '
            'save it as UTF-8'
        ) from None


def _too_deep() -> str:
    return f'is nested too deeply: at most {DEEPEST} lists and mappings may be within each other'


def _integer(text: str) -> int:
    if len(text) > _DIGITS:
        raise ParseError(f'has an integer of {len(text)} digits')
    return int(text)


@dataclass
class _Node:
    """A list or mapping of which the end has not come yet."""

    anchor: str | None
    keys: set[str] | None  # of a mapping, so far; None of a list, or where keys may repeat
    mapping: bool
    values: int = 1  # itself and all in it, aliases followed
    inside: int = field(default=0)  # keys and values so far


def _check_events(text: str, unique: bool) -> None:
    """Check a YAML text before anything is made of it.

    Raises:
        ParseError: it is beyond a limit, or has a key twice.
        yaml.YAMLError: it is not YAML.
    """
    open_: list[_Node] = []
    sizes: dict[str, int] = {}  # values of what an anchor names
    repeated = 0
    for event in yaml.parse(text, _SafeLoader):
        mark: Any = event.start_mark
        where = f'line {mark.line + 1}'
        if isinstance(event, yaml.CollectionStartEvent):
            if len(open_) >= DEEPEST:
                raise ParseError(f'{_too_deep()} ({where})')
            _count(open_, 0)
            mapping = isinstance(event, yaml.MappingStartEvent)
            keys: set[str] | None = set() if mapping and unique else None
            open_.append(_Node(event.anchor, keys, mapping))
        elif isinstance(event, yaml.CollectionEndEvent):
            node = open_.pop()
            if node.anchor is not None:
                sizes[node.anchor] = node.values
            if open_:
                open_[-1].values += node.values
        elif isinstance(event, yaml.AliasEvent):
            if event.anchor not in sizes:
                raise ParseError(
                    f'is not YAML: *{event.anchor} names nothing before it, or what it is part of '
                    f'({where})'
                )
            repeated += sizes[event.anchor]
            if repeated > MOST_REPEATED:
                raise ParseError(
                    f'has aliases that stand for more than {MOST_REPEATED} values ({where}): '
                    'write it without them'
                )
            _count(open_, sizes[event.anchor])
        elif isinstance(event, yaml.ScalarEvent):
            _check_scalar(event, open_, where)
            _count(open_, 1)
            if event.anchor is not None:
                sizes[event.anchor] = 1


def _count(open_: list[_Node], values: int) -> None:
    """Count a key or value of the innermost list or mapping."""
    if open_:
        open_[-1].values += values
        open_[-1].inside += 1


def _check_scalar(event: Any, open_: list[_Node], where: str) -> None:
    value = event.value
    if len(value) > _DIGITS and not event.style and _INTEGER.fullmatch(value):
        raise ParseError(f'has an integer of {len(value)} digits ({where})')
    if open_ and open_[-1].keys is not None and open_[-1].inside % 2 == 0 and value != '<<':
        if value in open_[-1].keys:
            raise ParseError(f'has the key {value[:_SHOWN]!r} twice in one mapping ({where})')
        open_[-1].keys.add(value)
