"""The part of a run's report that tells where it comes from: machine, command, settings, files."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

from codetr_ros import config
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs.document import (
    Block,
    Facts,
    Folded,
    Heading,
    Links,
    Paragraph,
    Table,
    cell,
    facts,
    records,
)
from codetr_ros.runs.run_summary import RunSummary

FILES = (
    (run_folder.CONFIG, 'every setting; codetr train --config repeats the run with it'),
    (run_folder.ORIGIN, 'how and where the run was begun'),
    (run_folder.BAG, 'the recording: every step, score, label, policy and result'),
    (run_folder.SUMMARY, 'the run for programs'),
    (run_folder.METRICS, 'a row for each phase: returns, losses, times'),
    (run_folder.STEP_REWARDS, 'the step rewards of the segments shown above'),
    (run_folder.CHECKPOINTS, 'the last policies and reward models'),
    (run_folder.MIDDLE, 'the policy half-way, for the film'),
    (run_folder.NODES, 'a report of each node'),
    (run_folder.LOGS, 'the output of each node'),
    (run_folder.STATUS, 'who took part and how far the run came, as codetr watch shows it'),
    (run_folder.EPISODE, 'the newest episode, step by step, as codetr watch shows it'),
    (run_folder.TENSORBOARD, 'events for TensorBoard'),
)
"""The files of a run's folder, each with what it is."""


def origin(summary: RunSummary, files: Sequence[tuple[str, str]]) -> Iterator[Block]:
    """Date, host, command, versions, settings of a run's own, and the files of its folder."""
    versions = {name: version for name, version in summary.versions.items() if version}
    rows: list[tuple[str, str]] = [
        ('begun', (summary.began or 'not recorded').replace('T', ' ')),
        ('on', summary.host or 'not recorded'),
        ('command', summary.command or 'not recorded'),
        ('run as', 'one process' if summary.in_process else 'ROS 2 nodes'),
        ('threads', f'{summary.settings.get("threads", "not recorded")} in each process'),
        ('versions', ', '.join(f'{name} {version}' for name, version in versions.items())),
    ]
    yield Heading('How it was made')
    yield Facts(rows)
    yield from own_settings(summary.settings)
    if files:
        yield Paragraph("In the run's folder:")
        yield Links(files)


def own_settings(settings: Mapping[str, Any], without: Collection[str] = ()) -> Iterator[Block]:
    """The settings that differ from the nearest preset.

    Args:
        settings: nested mapping, as JSON has it.
        without: settings, and groups of them, that have no effect.
    """
    preset = config.nearest(settings)
    changed = [
        [name, setting(there), setting(here)]
        for name, there, here in config.differences(settings, preset)
        if name.partition('.')[0] not in without
    ]
    if not changed:
        yield Paragraph(f'All settings are those of the preset {preset}.')
        return
    yield Paragraph(f'Settings that differ from the preset {preset}, the nearest:')
    yield Table(['setting', preset, 'here'], changed)


def setting(value: Any) -> str:
    """The value of a setting, for people."""
    return 'not given' if value is None else cell(value)


def details(summary: RunSummary) -> Iterator[Block]:
    """What only few people look for, folded."""
    messages = [{'topic': topic, **row.model_dump()} for topic, row in summary.messages.items()]
    processes = [
        {
            'process': name,
            'memory at most [MB]': f'{row.peak_rss_mb:.0f}' if row.peak_rss_mb else None,
            'processor time [s]': None if row.cpu_s is None else f'{row.cpu_s:.1f}',
            'time [s]': None if row.wall_s is None else f'{row.wall_s:.1f}',
            'finished': row.finished,
            'error': row.error,
            'exit code': row.exit_code,
            'started again': row.restarts,
        }
        for name, row in summary.processes.items()
    ]
    identity = ('run_id', 'policy_sha256', 'reward_model_sha256', 'settings_hash')
    every = [(name, setting(value)) for name, value in config.flatten(summary.settings)]
    yield Folded('Messages by topic', [records(messages)])
    yield Folded('Processes', [records(processes)])
    yield Folded(f'All {len(every)} settings', [Facts(every)])
    yield Folded('Identity', [facts({name: getattr(summary, name) for name in identity})])
