from collections.abc import Iterator

import pytest

from codetr_ros.processes.launcher import Processes
from helpers.programs import (
    PATIENCE,
    Said,
)


@pytest.fixture
def said() -> Said:
    return Said()


@pytest.fixture
def processes(said: Said) -> Iterator[Processes]:
    with Processes(said, stop_deadline=PATIENCE) as started:
        yield started
