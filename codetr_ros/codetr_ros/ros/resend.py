"""Sends a committed phase again to a node that lacks some of it."""

from codetr_msgs.srv import FetchPhase

from codetr_ros.nodes.last_phases import LastPhases
from codetr_ros.records.fields import type_name
from codetr_ros.records.shown import shown
from codetr_ros.ros.fetch import SERVICE
from codetr_ros.ros.link import Link


class Resender(LastPhases):
    """The last phases, and the service `fetch_phase` that sends one of them.

    Args:
        link: the node's connection.
        run_id: the run.
        phases: how many to hold.
    """

    def __init__(self, link: Link, run_id: str, phases: int) -> None:
        super().__init__(phases)
        self._log = link.node.get_logger()
        self._run_id = run_id
        link.node.create_service(FetchPhase, SERVICE, self._send)

    def _send(
        self, request: FetchPhase.Request, response: FetchPhase.Response
    ) -> FetchPhase.Response:
        if request.run_id != self._run_id:
            other = shown(repr(request.run_id))
            response.reason = (
                f'this recorder is of run {self._run_id!r}, not {other}: ask that of your run'
            )
            return response
        try:
            phase = self.get(request.phase)
        except KeyError as error:
            response.reason = str(error.args[0])
            return response
        self._log.warning(
            f'{shown(request.requester)} lacks something of phase {request.phase}: sending it '
            'again'
        )
        response.found = True
        response.types = [type_name(kind) for kind, _ in phase]
        response.lengths = [len(raw) for _, raw in phase]
        response.cdr = b''.join(raw for _, raw in phase)
        return response
