"""The settings that people change most, and how they are given as text."""

from collections.abc import Mapping
from typing import Any

from codetr_ros.config.base import SettingsError
from codetr_ros.config.run import Settings
from codetr_ros.system.parsing import ParseError, parse_yaml

USUAL = (
    *('task', 'composite', 'delay', 'method', 'steps', 'seed', 'warmup_steps', 'memory_steps'),
    *('overlap', 'simulators', 'envs', 'evaluate_every', 'evaluate_episodes', 'r_max'),
    *('threads', 'device', 'reward_device', 'codetr.label', 'codetr.gradient_steps'),
    'sac.hidden',
)
"""By dotted name: `--help` explains these alone, and the launch file has an argument for each."""


def from_text(
    base: Settings, given: Mapping[str, str], source: str
) -> tuple[Settings, dict[str, Any]]:
    """Settings that are given as text, such as arguments of a launch file.

    Args:
        base: the settings that they change.
        given: the text of each by its dotted name, as YAML has it; empty: as in `base`.
        source: where they come from, for errors.

    Returns:
        All settings, and the values of those that were given.

    Raises:
        SettingsError: one of them is refused.
    """
    changes: dict[str, Any] = {}
    for name, text in given.items():
        if not text:
            continue
        try:
            changes[name] = parse_yaml(text)
        except ParseError as error:
            raise SettingsError(f'{source}: {name}:={text} {error}') from None
    settings = base.changed(changes, source)
    flat = settings.flat()
    return settings, {name: flat[name] for name in changes}
