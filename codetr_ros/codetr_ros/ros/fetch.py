"""Asks other nodes for phases again: the recorder for a committed one, any other for what it has
published.

With a key of the run, each answer is signed, for one request alone. Whoever else answers is
refused and counted, and the true answer is waited for: the middleware hands over all of them.
"""

import hmac
import json
import secrets
import time
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from codetr_msgs.srv import FetchPhase

from codetr_ros.nodes.asking import NEWEST, SERVICE, Answer, MakeAsks
from codetr_ros.nodes.fetching import AGAIN
from codetr_ros.nodes.signing import signature
from codetr_ros.records import RecordError
from codetr_ros.records.fields import RECORD_TYPES
from codetr_ros.records.shown import shown
from codetr_ros.ros.link import Link

MOST_PENDING = 12
"""Requests for the same that may still be answered: those of a minute."""


def answer_signature(key: bytes, service: str, request: Any, response: Any) -> bytes:
    """The signature of an answer, which fits one request alone.

    Args:
        key: that of the run.
        service: its full name.
        request: of type `FetchPhase.Request`.
        response: of type `FetchPhase.Response`.
    """
    asked = [request.run_id, request.phase, list(request.kinds), request.part]
    answered = [response.found, response.reason, list(response.types), list(response.lengths)]
    numbers = [response.phase, response.parts]
    text = json.dumps([bytes(request.nonce).hex(), asked, answered, numbers])
    return signature(key, service, text.encode() + b'\0' + bytes(response.cdr))


def unpack(response: Any) -> Iterator[tuple[type, bytes]]:
    """Kind and bytes of each message in a response.

    Raises:
        RecordError: lengths disagree, or a type is no record.
    """
    lengths = list(response.lengths)
    if len(lengths) != len(response.types) or sum(lengths) != len(response.cdr):
        raise RecordError(
            f'{SERVICE}: {len(response.types)} types, {len(lengths)} lengths of {sum(lengths)} '
            f'bytes and {len(response.cdr)} bytes disagree: update the node that sends'
        )
    data = bytes(response.cdr)
    ends = np.cumsum(lengths, dtype=np.int64)
    for kind, length, end in zip(response.types, lengths, ends.tolist(), strict=True):
        if kind not in RECORD_TYPES:
            raise RecordError(
                f'{SERVICE}: {shown(repr(kind))} is not a type of record: update the node that '
                'sends'
            )
        yield RECORD_TYPES[kind], data[end - length : end]


class Asker:
    """Asks one node for phases, one after the other, each part by part.

    Args:
        link: the connection of who asks.
        service: the service that is asked.
        run_id: the run.
    """

    def __init__(self, link: Link, service: str, run_id: str) -> None:
        self._link = link
        self._run_id = run_id
        self._client = link.node.create_client(FetchPhase, service)
        self._full_name = link.node.resolve_service_name(service)
        self._pending: list[Any] = []  # the futures of the requests that may still be answered
        self._question: _Question | None = None  # the present one
        self._asked_at: float | None = None  # when the last part was asked for

    @property
    def service(self) -> str:
        """The full name of the service."""
        return str(self._client.srv_name)

    @property
    def ready(self) -> bool:
        """Whether the service is there."""
        return bool(self._client.service_is_ready())

    @property
    def busy(self) -> bool:
        """Whether an answer is still to be expected: a node that has died sends none."""
        return self._asked_at is not None and time.monotonic() < self._asked_at + AGAIN

    def ask(
        self, phase: int, answered: Callable[[Answer], None], kinds: Collection[str] = ()
    ) -> None:
        """Ask for a phase. An earlier question that has no answer yet is forgotten; if it was the
        same, an answer to it will do.

        Args:
            phase: which one, or `NEWEST`.
            answered: called by the main loop, once all parts have come or nothing is sent.
            kinds: types of the messages that are wanted; empty: all.
        """
        question, wanted = self._question, (phase, tuple(kinds))
        if self._asked_at is None or question is None or question.wanted != wanted:
            self._forget()
            question = self._question = _Question(wanted, phase, answered)
        question.answered = answered
        self._ask(question)

    def _ask(self, question: '_Question') -> None:
        self._asked_at = time.monotonic()
        request = FetchPhase.Request(
            run_id=self._run_id,
            phase=question.phase,
            requester=self._link.full_name,
            kinds=list(question.wanted[1]),
            part=question.part,
            nonce=np.frombuffer(secrets.token_bytes(16), np.uint8),
        )
        future = self._client.call_async(request)
        # the future stays pending: with the first answer, the middleware would drop all others
        future.set_result = lambda response: self._link.store(
            self._arrived, question, request, response
        )
        self._pending.append(future)
        if len(self._pending) > MOST_PENDING:
            self._client.remove_pending_request(self._pending.pop(0))

    def _forget(self) -> None:
        """Take no answer to the requests so far any more."""
        for future in self._pending:
            self._client.remove_pending_request(future)
        self._pending.clear()

    def _check(self, request: Any, response: Any) -> None:
        """Refuse an answer that is not signed with the key of the run, if there is one.

        Raises:
            RecordError: it is not.
        """
        key = self._link.key
        if key is None:
            return
        own = answer_signature(key, self._full_name, request, response)
        if not hmac.compare_digest(own, bytes(response.signature)):
            raise RecordError(
                f'an answer of {self._full_name!r} to the question for phase {request.phase} is '
                'not signed with the key of this run: look for a second node that offers this '
                'service'
            )

    def _arrived(self, question: '_Question', request: Any, response: Any) -> None:
        if question is not self._question or self._asked_at is None:
            return
        if question.part != request.part:
            return  # a second answer for a part that has come
        try:
            self._check(request, response)
        except RecordError as error:
            self._link.refuse(SERVICE, error)
            return
        self._forget()
        if not response.found:
            self._asked_at = None
            question.answered(Answer(None, shown(response.reason) or 'no reason is given'))
            return
        try:
            question.messages += unpack(response)
        except RecordError as error:
            self._asked_at = None
            question.answered(Answer(None, str(error)))
            return
        question.part += 1
        if question.part < response.parts and question.messages:
            question.phase = response.phase
            self._ask(question)
            return
        self._asked_at = None
        phase = None if response.phase == NEWEST else response.phase
        question.answered(Answer(phase, '', question.messages))


def askers(link: Link, run_id: str) -> MakeAsks:
    """What makes that which asks a service, by the service's name.

    Args:
        link: the connection of who asks.
        run_id: the run.
    """
    return lambda service: Asker(link, service, run_id)


@dataclass
class _Question:
    wanted: tuple[int, tuple[str, ...]]  # the phase and the kinds that are asked for
    phase: int  # which of them it is, once the first part has come
    answered: Callable[[Answer], None]
    part: int = 0
    messages: list[tuple[type, bytes]] = field(default_factory=list)
