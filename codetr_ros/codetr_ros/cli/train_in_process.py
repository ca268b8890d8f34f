"""`codetr train --in-process`: the run with plain calls, from its start or from where it ended."""

import os
import traceback
from collections.abc import Callable
from pathlib import Path

from codetr_ros.cli.audience import Audience
from codetr_ros.cli.outcome import Outcome
from codetr_ros.config import Settings
from codetr_ros.processes.openmp import threading_environment
from codetr_ros.processes.supervise import Interrupts
from codetr_ros.records import Record
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs import reports as node_reports
from codetr_ros.runs.reports import NodeReport
from codetr_ros.system.files import atomic_write


class _RefusedError(Exception):
    """A run that cannot be gone on with: why."""


def run(
    settings: Settings,
    run_id: str,
    folder: Path,
    audience: Audience,
    interrupts: Interrupts,
    bag: bool,
    resumed: bool,
) -> Outcome:
    """Do the run, or go on with it.

    Args:
        settings: its settings.
        run_id: its name.
        folder: its folder.
        audience: takes what it publishes.
        interrupts: counts the user's requests to stop.
        bag: whether it is recorded.
        resumed: whether it goes on from where it ended.
    """
    os.environ.update(threading_environment(settings))

    def tick() -> None:
        if interrupts.count:
            raise KeyboardInterrupt
        audience.tick()

    # A slice may be long: a second Ctrl-C does not wait for its end.
    interrupts.raising = True
    try:
        if resumed:
            return Outcome(_go_on(settings, run_id, folder, audience, tick))
        from codetr_ros.cores import in_process

        receive, attend = audience.receive, audience.live.attend
        return Outcome(in_process.run(settings, run_id, folder, receive, tick, attend, bag))
    except KeyboardInterrupt:
        audience.progress.log('stopped')
        return Outcome(node_reports.read_all(folder), interrupted=True)
    except _RefusedError as error:
        return Outcome({}, refused=str(error))
    except Exception as error:  # noqa: BLE001
        # The summary keeps what was learnt until now, and names the failure, whatever it is.
        log = folder / run_folder.LOGS / 'in_process.log'
        atomic_write(log, traceback.format_exc())
        reports = node_reports.read_all(folder)
        return Outcome(reports, failure=f'{type(error).__name__}: {error}', log=log)
    finally:
        interrupts.raising = False


def _go_on(
    settings: Settings, run_id: str, folder: Path, audience: Audience, tick: Callable[[], None]
) -> dict[str, NodeReport]:
    from codetr_ros.bags.errors import BagError
    from codetr_ros.cores import in_process, taking_up
    from codetr_ros.records import RecordError
    from codetr_ros.runs.checkpoints import CheckpointError

    def past(record: Record) -> None:
        audience.summary.receive(record)
        audience.progress.receive(record)

    try:
        parts = taking_up.prepare(
            settings, run_id, folder, audience.receive, tick, past, audience.progress.log
        )
    except (BagError, CheckpointError, RecordError) as error:
        raise _RefusedError(str(error)) from error
    audience.summary.go_on()
    audience.progress.go_on()
    audience.live.attend(parts.cores)
    return in_process.driven(parts)
