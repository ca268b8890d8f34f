"""A visitor without the key of a run that publishes well-formed lies, replays and junk on all of
its topics, and offers its services.
"""

import random
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from codetr_msgs.srv import FetchPhase

from codetr_ros.bags.definitions import decode_sent, encode, stamp_of
from codetr_ros.nodes.signing import signed
from codetr_ros.records import (
    TOPICS,
    Commit,
    CompositeReward,
    EpisodeResult,
    Metrics,
    Policy,
    Presence,
    Record,
    RunSpec,
    StepRewards,
    TaskSpec,
    Transitions,
    TrueRewards,
    metrics,
)
from codetr_ros.records.digests import digest
from codetr_ros.records.fields import type_name
from codetr_ros.records.roles import ROLES
from codetr_ros.ros import messages, qos
from helpers.builders import commit, policy, run, score, step_rewards, task_spec, transitions
from helpers.nodes import NAMESPACE, Nodes, Witness

FIRST = (RunSpec, TaskSpec, Policy, Commit)
"""What stays on its topic for whoever comes later."""
HEARD_BY_WITNESSES = (Presence, Commit, CompositeReward)
MADE_UP = 'ab' * 32
ANOTHER_KEY = bytes(32)
KEPT = 50
"""Messages of each topic that are kept, to be published again."""
ENDLESS = 2**64 - 1
NOTHING: dict[str, Any] = {
    'sources': (), 'transitions': np.empty(0, np.int64),
    'scorers': (), 'scores': np.empty(0, np.int64),
}  # fmt: skip


class Liar(Witness):
    """Hears everything, and has no key. Of presences it publishes again those of the simulator,
    which the test stops before.

    Attributes:
        rng: from which lies are drawn.
        told: how many lies were published, by topic.
        counted: the nodes' counts when they were looked at last.
        asked: how many questions its false services have answered.

    Args:
        nodes: those of the run.
        seed: of the lies.
        run_id: the run.
    """

    followed = tuple(TOPICS)

    def __init__(self, nodes: Nodes, seed: int = 0) -> None:
        super().__init__(nodes)
        self.rng = random.Random(seed)
        self._settings = nodes.settings
        self._heard: dict[type, deque[bytes]] = {kind: deque(maxlen=KEPT) for kind in TOPICS}
        self.told: Counter[str] = Counter()
        self.counted: dict[str, dict[str, str]] = {}
        self.asked = 0
        self._publishers: dict[type, Any] = {}

    def __enter__(self) -> 'Liar':
        super().__enter__()
        self.link.key = None
        for kind, topic in TOPICS.items():
            if kind not in HEARD_BY_WITNESSES:
                self.link.subscribe(kind, self._overhear, self._settings)
            self._publishers[kind] = self.link.node.create_publisher(
                messages.message_type(kind), topic, qos.profile(topic, self._settings)
            )
        return self

    def _hear(self, kind: type, data: bytes) -> None:
        super()._hear(kind, data)
        self._overhear(kind, data)

    def _committed(self, kind: type, data: bytes) -> None:
        super()._committed(kind, data)
        self._overhear(kind, data)

    def _scored(self, kind: type, data: bytes) -> None:
        super()._scored(kind, data)
        self._overhear(kind, data)

    def _overhear(self, kind: type, data: bytes) -> None:
        for record in self.sound(kind, data):
            # a copy that is read before its original would make a node refuse that one: of nodes
            # that go on publishing presences, a slow one may have some still to read
            if not isinstance(record, Presence) or record.role == 'sim':
                self._heard[kind].append(data)

    def heard(self, *kinds: type) -> bool:
        """Whether something of a node of the run has come on each of these topics."""
        return all(self._heard[kind] for kind in kinds)

    def matched(self, *kinds: type) -> bool:
        """Whether all that is published here on these topics reaches all who read them."""
        return all(
            self._publishers[kind].get_subscription_count() == len(self.readers(TOPICS[kind]))
            for kind in kinds
        )

    def _last(self, kind: type) -> Any:
        """The newest record of a kind by somebody else; None if there is none."""
        return decode_sent(kind, self._heard[kind][-1])[0] if self.heard(kind) else None

    def tell(self, kind: type, data: bytes) -> None:
        """Publish bytes on the topic of a kind of records, and count them."""
        self._publishers[kind].publish(data)
        self.told[TOPICS[kind]] += 1

    def tell_record(self, record: Record) -> None:
        """Publish a record that is not signed."""
        self.tell(type(record), self._message(record, self.link.instance))

    def tell_again(self, kind: type) -> None:
        """Publish the newest message of a topic once more, as it came."""
        self.tell(kind, self._heard[kind][-1])

    def tell_something(self, *kinds: type) -> None:
        """Publish a lie on the topic of one of these kinds of records: one that is made up, or
        something that was heard.
        """
        kind = self.rng.choice(kinds or tuple(TOPICS))
        self.tell(kind, self.rng.choice((self._made_up, self._again))(kind))

    def _message(self, record: Record, sender: str) -> bytes:
        now = self.link.node.get_clock().now().nanoseconds
        return encode(record, now, sender=sender)

    def _made_up(self, kind: type) -> bytes:
        record = LIES[kind](self, self.rng) if kind in LIES else None
        if record is None:
            return self._junk()
        senders = [self.link.instance, self.rng.choice([self._sender_of(kind), ''])]
        data = self._message(record, self.rng.choice(senders))
        if self.rng.random() < 0.5:
            return data
        return signed(ANOTHER_KEY, self.link.topic(kind), data)

    def _sender_of(self, kind: type) -> str:
        """Who publishes on a topic."""
        return decode_sent(kind, self._heard[kind][-1])[1] if self.heard(kind) else ''

    def _again(self, kind: type) -> bytes:
        """A message that was heard: as it came, later, altered, or that of another topic."""
        if not self.heard(kind):
            return self._junk()
        data = self.rng.choice(self._heard[kind])
        how = self.rng.randrange(4)
        if how == 0:
            return data
        if how == 1:  # the stamp is the first field
            seconds = stamp_of(data) // 10**9 + 3600
            return data[:4] + seconds.to_bytes(4, 'little') + data[8:]
        if how == 2:
            place = self.rng.randrange(4, len(data))
            return data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :]
        others = [other for other in TOPICS if other is not kind and self._heard[other]]
        return self.rng.choice(self._heard[self.rng.choice(others)]) if others else self._junk()

    def _junk(self) -> bytes:
        return self.rng.randbytes(self.rng.randrange(1, 400))

    def start_services(self, *names: str) -> None:
        """Offer the services of other nodes, and lie to whoever asks.

        Args:
            names: such as 'fetch_phase', the recorder's.
        """
        for name in names:
            self.link.node.create_service(FetchPhase, name, self._answer)

    def _answer(self, request: Any, response: Any) -> Any:
        self.asked += 1
        how = self.rng.randrange(4)
        if how == 0:
            response.reason = 'there is no such phase'
            return response
        response.found, response.phase, response.parts = True, self.rng.randrange(9), 1
        if how == 1:
            response.phase = FetchPhase.Request.NEWEST
            return response
        said = [self._made_up(kind) for kind in (Transitions, Commit, StepRewards)]
        response.types = [type_name(kind) for kind in (Transitions, Commit, StepRewards)]
        response.lengths = [len(data) + (how == 2) for data in said]
        response.cdr = b''.join(said)
        return response

    # ---- what is made up

    @property
    def _next(self) -> int:
        return self.commits[-1].phase + 1 if self.commits else 0

    def commit(self, rng: random.Random) -> Commit:
        """An early commit: empty, or one that follows on the newest."""
        if not self.commits or rng.random() < 0.5:
            return commit(phase=self._next + rng.randrange(2), **NOTHING)
        newest = self.commits[-1]
        return replace(
            newest,
            phase=self._next,
            previous=digest(newest),
            transitions=newest.transitions + rng.randrange(2),
        )

    def labels(self, rng: random.Random) -> StepRewards:
        """Labels of a coming phase."""
        made_of = digest(self.commits[-1]) if self.commits else ''
        return step_rewards(
            phase=self._next + rng.randrange(2), commit=rng.choice([MADE_UP, made_of, ''])
        )

    def steps(self, rng: random.Random) -> Transitions:
        """Steps of a source that exists, or of one that does not."""
        known = self._last(Transitions) or transitions()
        changed = known.observations + np.float32(1)
        return replace(
            known,
            source=rng.choice([known.source, 'stranger']),
            sequence=known.sequence + rng.randrange(2),
            observations=changed,
        )

    def score(self, rng: random.Random) -> CompositeReward:
        """A score that the simulator has not given."""
        known = self.scores[-1] if self.scores else score()
        return replace(known, value=9.0, sequence=known.sequence + rng.randrange(2))

    def task(self, rng: random.Random) -> TaskSpec:
        """Another task of the simulator, which asks for much memory."""
        return task_spec(
            observation_size=rng.choice([3, 100_000]), source=rng.choice(['sim', 'sim_2'])
        )

    def run(self, rng: random.Random) -> RunSpec:
        """Another run, or this one with other settings."""
        other = run(self._settings.changed({'seed': 99, 'memory_steps': 10_000_000}))
        return replace(other, run_id=rng.choice(['run', 'another']))

    def presence(self, rng: random.Random) -> Presence:
        """A node that has published without end, or has finished."""
        role, known = rng.choice(ROLES), self._last(Presence)
        instance = known.instance_id if known and rng.random() < 0.5 else self.link.instance
        return Presence(
            run_id='run',
            role=role,
            node=f'{NAMESPACE}/{role}',
            instance_id=instance,
            settings_hash='',
            finished=rng.random() < 0.5,
            topics=('transitions', 'commits'),
            published=np.full(2, ENDLESS, np.uint64),
            missed=0,
        )

    def policy(self, rng: random.Random) -> Policy:
        """Permission for a phase to come, or the end of the run."""
        steps = rng.choice([0, self._settings.phase_steps])
        return policy(phase=self._next + rng.randrange(2), steps=np.array([steps], np.uint32))

    def _of_those_heard(self, kind: type, **changes: Any) -> Record | None:
        known = self._last(kind)
        return known and replace(known, **changes)


LIES: dict[type, Callable[[Liar, random.Random], Record | None]] = {
    Commit: Liar.commit,
    StepRewards: Liar.labels,
    Transitions: Liar.steps,
    CompositeReward: Liar.score,
    TaskSpec: Liar.task,
    RunSpec: Liar.run,
    Presence: Liar.presence,
    Policy: Liar.policy,
    EpisodeResult: lambda liar, rng: liar._of_those_heard(EpisodeResult, true_return=1e9),
    TrueRewards: lambda liar, rng: liar._of_those_heard(TrueRewards, phase=rng.randrange(9)),
    Metrics: lambda liar, rng: metrics('run', rng.choice(ROLES), 'sim', 0, 0, {'loss': 1e9}),
}
"""What is made up on each topic; on others, junk is published."""
