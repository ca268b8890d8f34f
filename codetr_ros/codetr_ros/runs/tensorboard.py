"""The numbers of a run as TensorBoard's events: `tensorboard --logdir RUN/tensorboard`."""

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from codetr_ros.config import Settings
from codetr_ros.records import EpisodeResult, Metrics, Record
from codetr_ros.system.files import make_folder

FLUSH = 2.0
"""Seconds after which events are in the file, so that a live view is no older."""
OF_EPISODES = ('true_return', 'composite_return', 'score', 'length')


class Events:
    """Writes each number as it comes: metrics as `<node>/<name>`, training episodes one by one as
    `training/<name>`, evaluations as the means of their episodes, `evaluation/<name>`. The x axis
    counts environment steps.

    Events that cannot be written end the writing, not the run: the reason is logged once.

    Args:
        folder: of the events.
        settings: of the run.
        log: prints a line for people.

    Raises:
        OSError: the folder cannot be written.
    """

    def __init__(self, folder: Path, settings: Settings, log: Callable[[str], None]) -> None:
        # takes a second, and most runs need none of it
        from tensorboardX.event_file_writer import EventsWriter
        from tensorboardX.proto import event_pb2, summary_pb2

        make_folder(folder)
        # its own writer, which waits for the file: those above it have a thread, which would end
        # at the first error, and a queue, which would then be full for ever
        self._writer: Any = EventsWriter(str(folder / 'events'))
        self._event, self._summary = event_pb2.Event, summary_pb2.Summary
        self._log = log
        self._episodes = settings.evaluate_episodes
        self._evaluation: list[EpisodeResult] = []
        self._flushed = time.monotonic()

    def receive(self, record: Record) -> None:
        """Note a record of the run, of any kind."""
        if isinstance(record, Metrics):
            node = record.node.rsplit('/', 1)[-1]
            values = dict(zip(record.names, record.values.tolist(), strict=True))
            self._write(node, record.step, values)
        elif isinstance(record, EpisodeResult) and record.purpose == 'training':
            values = {name: getattr(record, name) for name in OF_EPISODES}
            self._write('training', record.step, values)
        elif isinstance(record, EpisodeResult):
            self._evaluated(record)

    def _evaluated(self, record: EpisodeResult) -> None:
        self._evaluation.append(record)
        if len(self._evaluation) < self._episodes:
            return
        results, self._evaluation = self._evaluation, []
        means = {
            name: float(np.mean([getattr(result, name) for result in results]))
            for name in OF_EPISODES
        }
        self._write('evaluation', 0 if record.purpose == 'random' else record.step, means)

    def _write(self, group: str, step: int, values: Mapping[str, float]) -> None:
        if self._writer is None:
            return
        named = [
            self._summary.Value(tag=f'{group}/{name}', simple_value=value)
            for name, value in values.items()
        ]
        event = self._event(wall_time=time.time(), step=step, summary=self._summary(value=named))
        now = time.monotonic()
        try:
            self._writer.write_event(event)
            if now - self._flushed >= FLUSH:
                self._writer.flush()
                self._flushed = now
        except OSError as error:
            self._give_up(error)

    def _give_up(self, error: OSError) -> None:
        self._writer = None
        self._log(f'no more events for TensorBoard, the rest of the run has none: {error}')

    def close(self) -> None:
        """Write what is left."""
        if self._writer is not None:
            try:
                self._writer.close()
            except OSError as error:
                self._give_up(error)
