"""Policies of phases that, as far as the simulator knows that receives them, cannot have begun."""

from typing import TYPE_CHECKING

from codetr_ros.config import Settings
from codetr_ros.nodes.peers import Peers
from codetr_ros.nodes.traffic import Traffic
from codetr_ros.records import Policy, Record, RecordError

if TYPE_CHECKING:  # its imports take seconds, and follow once the run is known
    from codetr_ros.cores.simulator import Simulator

MOST = 64
"""Policies that are held; the oldest are let go first."""


class Behind:
    """Holds such policies until the recorder has answered which phase is committed.

    Either the simulator was left out meanwhile, and phases were committed without it: then it goes
    on behind them. Or it has caught up by itself since they came: then it takes them. Or who
    published the policies had no right to: then they are refused.

    Args:
        traffic: hands records to the core.
        core: the simulator's.
        settings: of the run.
    """

    def __init__(self, traffic: Traffic, core: 'Simulator', settings: Settings) -> None:
        self._traffic = traffic
        self._core = core
        self._settings = settings
        self._held: dict[int, tuple[Policy, RecordError]] = {}  # with why it cannot be taken
        if not settings.alone:  # else no phase goes on without it
            traffic.early = self._hold

    def _hold(self, record: Record, error: RecordError) -> bool:
        if not isinstance(record, Policy):
            return False
        self._held.setdefault(record.phase, (record, error))
        while len(self._held) > MOST:
            del self._held[min(self._held)]
        return True

    @property
    def asks(self) -> bool:
        """Whether the simulator waits for a policy while it holds later ones."""
        return bool(self._held) and self._core.lacks_permission

    def over(self, peers: Peers) -> bool:
        """Whether the run is over: the recorder has finished, and need not have waited for this
        simulator. It then has nothing more to do, even in the midst of a phase: nobody takes its
        steps, and nobody answers it.

        Args:
            peers: the other nodes.
        """
        if self._settings.alone or not peers.recorded():
            return False
        if not self._core.finished:
            self._held = {}
            self._core.pass_over(self._settings.phases)
        return True

    def answered(self, newest: int | None) -> None:
        """Go on where the run stands.

        Args:
            newest: the last committed phase; None if there is none.
        """
        held, self._held = self._held, {}
        passed = newest is not None and newest >= self._core.due
        if newest is not None and passed:
            self._core.pass_over(newest + 1)
        for phase, (policy, _) in sorted(held.items()):
            if phase >= self._core.due:  # the simulator may have gone on since it came
                self._traffic.receive(policy)
        if not passed:
            self._refuse_all()

    def _refuse_all(self) -> None:
        held, self._held = self._held, {}
        for _, error in held.values():
            self._traffic.refuse(Policy, error)
