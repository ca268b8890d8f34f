"""The services with which anything scores: `score_segment` and `wanted_segments`."""

import math
import time
from collections.abc import Callable
from typing import Any, cast

from codetr_msgs.srv import ScoreSegment, WantedSegments

from codetr_ros.cores.desks import LONGEST_REASON, Desks
from codetr_ros.cores.scoring import Desk, ScoringError
from codetr_ros.nodes.signing import token
from codetr_ros.records.shown import shown, worth_a_line
from codetr_ros.ros.joining import Joined
from codetr_ros.ros.membership import Membership
from codetr_ros.ros.wiring import Wiring

SCORE, WANTED = 'score_segment', 'wanted_segments'


class ScoringServices(Wiring):
    """The wiring of desks: services take judgements in, and topics carry them away.

    Args:
        member: the node's membership.
        joined: the run that it has joined.
        show: prints for people how the services are called.
    """

    def __init__(self, member: Membership, joined: Joined, show: Callable[[str], None]) -> None:
        super().__init__(member, joined)
        self._desks = cast('Desks', joined.core)
        self._show = show
        self._refused = 0

    def open(self) -> None:
        """Subscribe to the run's topics, and serve."""
        super().open()
        node = self.member.link.node
        self._desks.token = token(self.member.link.key, str(node.get_namespace()))
        node.create_service(ScoreSegment, SCORE, self._score)
        node.create_service(WantedSegments, WANTED, self._wanted)
        where = f'scores by service: {node.resolve_service_name(SCORE)}'
        self._show(f'{where}, token {self._desks.token}' if self._desks.token else where)

    def _score(self, request: Any, response: Any) -> Any:
        try:
            desk = self._desks.desk(request.scorer, request.token)
            if len(request.reason) > LONGEST_REASON:
                raise ScoringError(
                    f'reason has {len(request.reason)} characters: give {LONGEST_REASON} at most'
                )
            if not request.cannot_tell and math.isnan(request.value):
                raise ScoringError('value is NaN: give a number, or set cannot_tell')
            value = math.nan if request.cannot_tell else request.value
            segment = (request.source, request.episode, request.first_step, request.length)
            scale = (request.lowest, request.highest)
            given = self._desks.score(desk, segment, value, scale)
        except ScoringError as error:
            return self._refuse(request.scorer, SCORE, error, response)
        response.accepted, response.sequence = True, given.record.sequence
        response.phase = given.after + 1
        response.message = (
            f'published as number {response.sequence} of {desk.scorer!r}: the commit of phase '
            f'{response.phase} may take it, or a later one'
        )
        if request.reason:
            self.log.info(f'{response.message}; reason: {shown(request.reason)}')
        return response

    def _wanted(self, request: Any, response: Any) -> Any:
        try:
            desk = self._desks.desk(request.scorer, request.token)
        except ScoringError as error:
            return self._refuse(request.scorer, WANTED, error, response)
        wanted = self._desks.wanted(desk, request.most, request.steps)
        response.accepted = True
        for name, values in zip(
            ('sources', 'episodes', 'first_steps', 'lengths'),
            zip(*wanted.segments, strict=True),
            strict=False,  # none, if there are no segments
        ):
            setattr(response, name, list(values))
        response.observation_size = wanted.observations.shape[1]
        response.action_size = wanted.actions.shape[1]
        response.observations.frombytes(wanted.observations.astype('f4').tobytes())
        response.actions.frombytes(wanted.actions.astype('f4').tobytes())
        return self._state(desk, response)

    def _state(self, desk: Desk, response: Any) -> Any:
        response.phase = self._desks.seen.phase
        response.finished = self._desks.inform(desk, time.monotonic())
        response.given, response.taken = desk.count, desk.taken
        return response

    def settled(self, seconds: float) -> bool:
        """Whether all programs that score have received that the run has ended: they would wait
        in vain for services that are gone.
        """
        return not self._desks.awaits(time.monotonic())

    def _refuse(self, scorer: str, service: str, error: ScoringError, response: Any) -> Any:
        """Answer why nothing is taken, and log it: the first ten times, then every thousandth."""
        self._refused += 1
        if worth_a_line(self._refused):
            self.log.error(
                f'refused a call of {service} by {shown(repr(scorer))} (number '
                f'{self._refused}): {error}'
            )
        response.accepted, response.message = False, str(error)
        return response
