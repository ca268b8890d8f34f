"""Write settings.md from the settings themselves: `python docs/settings_page.py`.

The page, `codetr train --help-all`, the ROS parameters and the refusals thus have one source: the
descriptions in `codetr_ros/config/`. A test holds that the page is current.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from codetr_ros.config import Settings, load
from codetr_ros.runs.numbers import exact

PAGE = Path(__file__).with_name('settings.md')
HEAD = """\
# Settings

Everything that the parts of a run must agree on. This page is generated from the descriptions in
the code, as are `codetr train --help-all` and the ROS parameters (`ros2 param describe
/run_1/learner delay`), so all three agree. `codetr train --help` explains the twenty that people
change most.

A setting has one name everywhere:

| where | how |
|---|---|
| command line | `--sac.batch 128`; true or false: `--overlap`, `--no-overlap`, `--sac.no-compile`; numbers: `--sac.hidden 64 64` |
| YAML file, for `--config FILE` | `sac: {batch: 128}` |
| ROS parameter of the learner | `-p sac.batch:=128` |

The defaults are the paper's: they are the preset `paper`. The presets `cpu` and `quick` change what
their columns show. `codetr train` starts from `quick` unless `--config` names another preset or a
file; a file changes the defaults. Unknown names and values out of range are refused, with the name,
the value, and what is allowed.
"""  # noqa: E501  (a row of a table is a line)


def page() -> str:
    """The whole page."""
    presets = [load(name) for name in ('cpu', 'quick')]
    if load('paper') != Settings():
        raise SystemExit(
            'the preset paper differs from the defaults: change HEAD, which denies it'
        )
    parts = [HEAD]
    groups = {name: f for name, f in Settings.model_fields.items() if is_group(f)}
    plain = [f for f in Settings.model_fields.items() if not is_group(f[1])]
    parts += section('The run', '', plain, presets)
    for name, field in groups.items():
        kind = field.annotation
        assert isinstance(kind, type)
        assert issubclass(kind, BaseModel)
        title = f'`{name}`: {field.description}'
        parts += section(title, f'{name}.', list(kind.model_fields.items()), presets)
    return '\n'.join(parts)


def is_group(field: FieldInfo) -> bool:
    """Whether a field holds settings of its own."""
    return isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel)


def section(
    title: str, prefix: str, fields: list[tuple[str, FieldInfo]], presets: list[Settings]
) -> Iterator[str]:
    """A heading and a table."""
    yield f'## {title}\n'
    yield '| setting | what it decides | allowed | default | `cpu` | `quick` |'
    yield '|---|---|---|---|---|---|'
    for name, field in fields:
        dotted = f'{prefix}{name}'
        default = Settings().flat()[dotted]
        values = [preset.flat()[dotted] for preset in presets]
        changed = ['' if value == default else f'`{shown(value)}`' for value in values]
        cells = [
            f'`{dotted}`',
            escaped(field.description or ''),
            allowed(field),
            f'`{shown(default)}`',
            *changed,
        ]
        yield f'| {" | ".join(cells)} |'
    yield ''


def shown(value: Any) -> str:
    """A value as YAML and the command line have it."""
    if value is None:
        return 'not given'
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return exact(value)
    return (' '.join(map(str, value)) or '[]') if isinstance(value, tuple) else str(value)


def allowed(field: FieldInfo) -> str:
    """What a setting may be."""
    kind = field.annotation
    if get_origin(kind) is Literal:
        return ', '.join(f'`{choice}`' for choice in get_args(kind))
    if kind is bool:
        return '`true`, `false`'
    if get_origin(kind) is tuple:
        return '1 to 8 whole numbers' if field.default else 'names'
    if kind is str:
        has_pattern = any(getattr(rule, 'pattern', None) for rule in field.metadata)
        return '`cpu`, `cuda`, `cuda:1`, ...' if has_pattern else 'text'
    return ', '.join(bounds(field))


def bounds(field: FieldInfo) -> Iterator[str]:
    """The least and the largest value of a number."""
    for rule in field.metadata:
        for name, sign in (('ge', '≥'), ('gt', '>'), ('le', '≤'), ('lt', '<')):
            value = getattr(rule, name, None)
            if value is not None:
                yield f'{sign} {shown(value)}'


def escaped(text: str) -> str:
    """Text in a cell of a table; names and formulas with an asterisk stay as they are."""
    return text.replace('|', '\\|').replace('*', '\\*')


if __name__ == '__main__':
    PAGE.write_text(page())
