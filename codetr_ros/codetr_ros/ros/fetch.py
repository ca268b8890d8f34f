"""Fetches a committed phase again from the recorder, for a node that lacks some of it."""

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from codetr_msgs.srv import FetchPhase

from codetr_ros.nodes.fetching import Fetching
from codetr_ros.nodes.traffic import Traffic
from codetr_ros.records import RecordError
from codetr_ros.records.fields import RECORD_TYPES
from codetr_ros.records.shown import shown
from codetr_ros.ros.link import Link

SERVICE = 'fetch_phase'


def unpack(response: Any) -> Iterator[tuple[type, bytes]]:
    """Kind and bytes of each message in a response.

    Raises:
        RecordError: lengths disagree, or a type is no record.
    """
    lengths = list(response.lengths)
    if len(lengths) != len(response.types) or sum(lengths) != len(response.cdr):
        raise RecordError(
            f'{SERVICE}: {len(response.types)} types, {len(lengths)} lengths of {sum(lengths)} '
            f'bytes and {len(response.cdr)} bytes disagree: update the recorder'
        )
    data = bytes(response.cdr)
    ends = np.cumsum(lengths, dtype=np.int64)
    for kind, length, end in zip(response.types, lengths, ends.tolist(), strict=True):
        if kind not in RECORD_TYPES:
            raise RecordError(
                f'{SERVICE}: {shown(repr(kind))} is not a type of record: update the recorder'
            )
        yield RECORD_TYPES[kind], data[end - length : end]


class Fetcher:
    """Asks the recorder for a phase that stays incomplete.

    Args:
        link: the node's connection.
        run_id: the run.
        traffic: takes each message that arrives.
    """

    def __init__(self, link: Link, run_id: str, traffic: Traffic) -> None:
        self._link = link
        self._run_id = run_id
        self._traffic = traffic
        self._client = link.node.create_client(FetchPhase, SERVICE)
        self._fetching = Fetching()

    def check(self, missing: int | None) -> None:
        """Ask for a phase that has been incomplete for a while.

        Args:
            missing: the committed phase that is incomplete, None if there is none.
        """
        if not self._fetching.due(missing, time.monotonic()):
            return
        log = self._link.node.get_logger()
        if not self._client.service_is_ready():
            log.warning(
                f'phase {missing} is incomplete, and no recorder offers {self._client.srv_name!r}'
            )
            return
        log.warning(f'phase {missing} is incomplete: asking the recorder for it')
        request = FetchPhase.Request(
            run_id=self._run_id, phase=missing, requester=self._link.full_name
        )
        future = self._client.call_async(request)
        future.add_done_callback(lambda reply: self._link.store(self._arrived, missing, reply))

    def _arrived(self, phase: int, reply: Any) -> None:
        response = reply.result()
        log = self._link.node.get_logger()
        if not response.found:
            reason = shown(response.reason)
            log.error(f'the recorder does not send phase {phase} again: {reason}')
            return
        came = 0
        try:
            for kind, data in unpack(response):
                came += 1
                self._traffic.take_again(kind, data)
        except RecordError as error:
            self._traffic.refuse(SERVICE, error)
        else:
            self._traffic.core.fetched(phase)
        log.info(f'phase {phase}: {came} messages came again')
