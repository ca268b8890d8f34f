"""How many threads the products of a run get.

2           so many, wherever the run is done
auto        those that pay on the machine at hand, decided once when the run is made

What was measured: docs/decisions/0021-threads-where-they-pay.md.
"""

from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BeforeValidator
from pydantic_core import PydanticCustomError

from codetr_ros.config.base import Whole
from codetr_ros.system import processors

if TYPE_CHECKING:
    from codetr_ros.config.methods import SacSettings
    from codetr_ros.config.run import Settings

AUTO = 'auto'
LIMIT = 256
"""The most threads that may be asked for."""
MOST = 4
"""The most that `auto` takes. Two were measured; the products of a batch hardly feed more."""
LEAST_PRODUCT = 256 * 256 * 256
"""Multiplications in the largest product of a SAC update from which on a second thread pays."""


def checked(value: Any) -> int | str:
    """Threads as settings hold them: a number or `auto`.

    Raises:
        PydanticCustomError: it is neither.
    """
    threads: int | str = int(value) if isinstance(value, str) and value.isdecimal() else value
    if threads == AUTO:
        return AUTO
    whole = isinstance(threads, int) and not isinstance(threads, bool)
    if not whole or not 1 <= int(threads) <= LIMIT:
        why = f'threads are a number from 1 to {LIMIT}, or {AUTO}'
        raise PydanticCustomError('threads', '{why}', {'why': why})
    return threads


Threads = Annotated[int | Literal['auto'], BeforeValidator(checked), Whole(1, LIMIT)]
"""A number of threads in settings."""


class Threaded:
    """The threads of a run, mixed into its settings."""

    if TYPE_CHECKING:  # fields of `Settings`; with annotations at run time they would come first
        threads: int | Literal['auto']
        overlap: bool
        simulators: int
        device: str
        sac: SacSettings

        @property
        def labels_steps(self) -> bool:
            """Whether a reward method labels steps."""

    @property
    def stages_at_a_time(self) -> int:
        """Processes of the run that compute at the same time, apart from evaluation: the
        simulators, and with overlap the learner or the reward node beside them.
        """
        return self.simulators + self.overlap

    @property
    def threads_pay(self) -> bool:
        """Whether the run's largest part, the updates of SAC, is faster with a second thread."""
        if self.device != 'cpu' or not self.labels_steps:
            return False
        widths = sorted(self.sac.hidden)[-2:]
        return self.sac.batch * widths[0] * widths[-1] >= LEAST_PRODUCT

    def threads_on(self, cores: int, runs: int = 1) -> int:
        """The threads of each process on a machine.

        Args:
            cores: processors that the runs may use.
            runs: runs that are done there side by side.

        Returns:
            What was asked for; for `auto` an equal share of the cores where threads pay, else 1.
        """
        if isinstance(self.threads, int):
            return self.threads
        share = cores // (runs * self.stages_at_a_time) if self.threads_pay else 1
        return max(1, min(share, MOST))

    @property
    def thread_count(self) -> int:
        """The threads of each process: those recorded, or what `auto` is on this machine."""
        return self.threads_on(processors.count())


def settled(settings: 'Settings', runs: int = 1) -> 'Settings':
    """The same settings with a number of threads, as a run records them: the number decides bits.

    Args:
        settings: the settings; those with a number are returned as they are.
        runs: runs that are done on this machine side by side.
    """
    threads = settings.threads_on(processors.count(), runs)
    return settings.model_copy(update={'threads': threads})
