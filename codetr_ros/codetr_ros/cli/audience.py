"""Who receives the records of a run that `codetr train` does: all of it, in one place."""

from collections.abc import Sequence
from dataclasses import dataclass

from codetr_ros.cli.beside import Beside
from codetr_ros.records import Record
from codetr_ros.runs.live import Live
from codetr_ros.runs.middle import Middle
from codetr_ros.runs.progress import Progress
from codetr_ros.runs.summary import Summary
from codetr_ros.runs.tensorboard import Events


@dataclass(frozen=True)
class Audience:
    """Receives what a run publishes.

    Attributes:
        summary: makes `summary.json` at the end.
        progress: shows how far the run has come.
        live: writes the files that change while the run lasts.
        events: writes TensorBoard's events; None: nobody asked for them.
        pages: serve pages of the run.
        middle: keeps the policy of the middle of the run; None: nobody draws it.
    """

    summary: Summary
    progress: Progress
    live: Live
    events: Events | None = None
    pages: Sequence[Beside] = ()
    middle: Middle | None = None

    def receive(self, record: Record) -> None:
        """Hand on a record."""
        self.summary.receive(record)
        self.progress.receive(record)
        self.live.receive(record)
        if self.events is not None:
            self.events.receive(record)

    def tick(self) -> None:
        """Show what has changed, where it is time. Call it now and then."""
        self.progress.tick()
        self.live.tick()
        for page in self.pages:
            page.tick()
        if self.middle is not None:
            self.middle.look(self.summary.phases)

    def end(self) -> None:
        """Write what is left of the events."""
        if self.events is not None:
            self.events.close()
