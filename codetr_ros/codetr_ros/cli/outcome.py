"""How a run of `codetr train` ended."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from codetr_ros.runs.live import State
from codetr_ros.runs.reports import NodeReport


@dataclass
class Outcome:
    """How a run ended."""

    reports: Mapping[str, NodeReport]
    interrupted: bool = False
    failure: str | None = None
    log: Path | None = None  # explains the failure
    refused: str | None = None  # why it was not even gone on with: nothing was changed

    @property
    def state(self) -> State:
        """How it ended, in a word."""
        if self.failure:
            return 'failed'
        return 'interrupted' if self.interrupted else 'finished'
