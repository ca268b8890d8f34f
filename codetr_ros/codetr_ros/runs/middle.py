"""Keeps the policy that a run has half-way, for the report: later checkpoints replace it."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

from codetr_ros.config import Settings
from codetr_ros.runs import folder as run_folder


class Middle:
    """Copies the learner's checkpoint in the middle of a run into the folder `middle_policy`.

    Args:
        folder: of the run.
        settings: of the run.
        log: prints a line for people.
    """

    def __init__(self, folder: Path, settings: Settings, log: Callable[[str], None]) -> None:
        self._folder = folder
        self._log = log
        self._phase = settings.phases // 2 - 1
        kept = (folder / run_folder.MIDDLE).exists()  # of a run that goes on
        if kept or self._phase < max(0, settings.warmup_phases - 1):
            self._phase = settings.phases  # never: else the policy has learnt nothing by then

    def look(self, committed: int) -> None:
        """Keep the policy if the run has come so far. Call it now and then.

        Args:
            committed: phases that are committed.
        """
        if committed <= self._phase:
            return
        newest = max((self._folder / run_folder.CHECKPOINTS).glob('learner-*'), default=None)
        if newest is None or int(newest.name.rpartition('-')[2]) < self._phase:
            return
        partial = self._folder / f'.{run_folder.MIDDLE}.partial'
        try:
            shutil.rmtree(partial, ignore_errors=True)
            shutil.copytree(newest, partial / newest.name)
            os.rename(partial, self._folder / run_folder.MIDDLE)
        except (FileNotFoundError, shutil.Error):
            return  # it was replaced by a newer one just now
        except OSError as error:
            self._log(f'the report will not show the policy of the middle of the run: {error}')
        self._phase = 2**63  # never again
