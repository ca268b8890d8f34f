"""Sends a phase again to a node that lacks some of it, in parts."""

from collections.abc import Callable, Collection, Iterable

import numpy as np
from codetr_msgs.srv import FetchPhase

from codetr_ros.nodes.asking import NEWEST, SERVICE, Read, answer_to, service_of
from codetr_ros.nodes.last_phases import LastPhases
from codetr_ros.nodes.outbox import Outbox
from codetr_ros.records.fields import type_name
from codetr_ros.records.shown import shown
from codetr_ros.ros.fetch import answer_signature
from codetr_ros.ros.link import Link

PART_BYTES = 4_000_000
"""Bytes of messages in an answer, unless one message has more."""

MOST_REQUESTERS = 100
"""Nodes of which is remembered what they were sent."""


class PhaseService:
    """A service of type `FetchPhase`.

    Args:
        link: the node's connection.
        service: its name.
        run_id: the run.
        read: reads a phase.
        newest: returns the newest phase that can be read; None if there is none.
    """

    def __init__(
        self,
        link: Link,
        service: str,
        run_id: str,
        read: Read,
        newest: Callable[[], int | None],
    ) -> None:
        self._who = link.full_name
        self._key = link.key
        self._full_name = link.node.resolve_service_name(service)
        self._log = link.node.get_logger()
        self._run_id = run_id
        self._read = read
        self._newest = newest
        self._sent: dict[str, int] = {}  # the phase that was sent last, by requester
        link.node.create_service(FetchPhase, service, self._answer)

    def _answer(
        self, request: FetchPhase.Request, response: FetchPhase.Response
    ) -> FetchPhase.Response:
        response = self._send(request, response)
        if self._key is not None:
            sign = answer_signature(self._key, self._full_name, request, response)
            response.signature = np.frombuffer(sign, np.uint8)
        return response

    def _send(
        self, request: FetchPhase.Request, response: FetchPhase.Response
    ) -> FetchPhase.Response:
        if request.run_id != self._run_id:
            response.reason = (
                f'{self._who} is of run {self._run_id!r}, not {shown(repr(request.run_id))}: ask '
                'the nodes of your run'
            )
            return response
        answer = answer_to(request.phase, request.kinds, self._read, self._newest, self._log)
        if answer.reason:
            response.reason = answer.reason
            return response
        phase, parts = answer.phase, _parts(answer.messages)
        if phase is None:  # there is none, which is an answer
            response.found, response.phase, response.parts = True, NEWEST, 1
            return response
        if request.part >= len(parts):
            response.reason = f'phase {phase} has {len(parts)} parts, not {request.part + 1}'
            return response
        part = parts[request.part]
        self._note(request.requester, phase)
        response.found, response.phase, response.parts = True, phase, len(parts)
        response.types = [type_name(kind) for kind, _ in part]
        response.lengths = [len(raw) for _, raw in part]
        response.cdr = b''.join(raw for _, raw in part)
        return response

    def _note(self, requester: str, phase: int) -> None:
        """Log who lacks something, once where a node asks for one phase after the other: up to
        where the run stands, or back to where its episode began.
        """
        before = self._sent.get(requester)
        if len(self._sent) > MOST_REQUESTERS:
            self._sent.clear()
        self._sent[requester] = phase
        if before is None or abs(phase - before) > 1:
            self._log.warning(
                f'{shown(requester)} lacks something of phase {phase}: sending it again'
            )


def _parts(messages: Iterable[tuple[type, bytes]]) -> list[list[tuple[type, bytes]]]:
    """Messages in parts of at most `PART_BYTES`, at least one."""
    parts: list[list[tuple[type, bytes]]] = [[]]
    size = 0
    for kind, raw in messages:
        if parts[-1] and size + len(raw) > PART_BYTES:
            parts.append([])
            size = 0
        parts[-1].append((kind, raw))
        size += len(raw)
    return parts


class Resender(LastPhases):
    """The last phases, and the service `fetch_phase` that sends one of them.

    Args:
        link: the recorder's connection.
        run_id: the run.
        phases: how many are held.
    """

    def __init__(self, link: Link, run_id: str, phases: int) -> None:
        super().__init__(phases)
        PhaseService(link, SERVICE, run_id, self.read, lambda: self.newest)

    def read(self, phase: int, kinds: Collection[str]) -> list[tuple[type, bytes]]:
        """Kind and bytes of each message of a committed phase."""
        held = self.get(phase)
        return [(kind, raw) for kind, raw in held if not kinds or type_name(kind) in kinds]


def serve_outbox(link: Link, run_id: str, outbox: Outbox) -> None:
    """Offer to send again what a node has published lately."""

    def read(phase: int, kinds: Collection[str]) -> list[tuple[type, bytes]]:
        there = outbox.read(phase, kinds)
        return [(type(record), link.message(record, stamp)) for record, stamp in there]

    PhaseService(link, service_of(link.full_name), run_id, read, lambda: outbox.newest)
