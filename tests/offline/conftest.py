from dataclasses import dataclass
from pathlib import Path

import pytest

from codetr_ros.config import Settings
from codetr_ros.cores import in_process
from codetr_ros.records import Record
from codetr_ros.runs.reports import NodeReport
from helpers.builders import tiny
from helpers.foreign_bags import write


@dataclass
class Run:
    """A run in this process, and a bag of all that was said in it."""

    settings: Settings
    records: list[Record]
    reports: dict[str, NodeReport]
    bag: Path


@pytest.fixture(scope='session')
def a_run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    settings = tiny(
        task='Reacher-v5',
        steps=1000,
        sac__updates_per_step=0.02,
        evaluate_every=0,
        memory_steps=700,
    )
    records: list[Record] = []
    reports = in_process.run(settings, 'calls', observe=records.append)
    bag = write(tmp_path_factory.mktemp('run') / 'bag', records)
    return Run(settings, records, reports, bag)
