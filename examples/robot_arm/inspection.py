"""An inspection that scores attempts of the stand-in arm: the only node that knows what is good.

    .venv/bin/python examples/robot_arm/inspection.py --ros-args -r __ns:=/my_run

It receives the steps of the run and looks at where the hand was. For each segment that is over it
publishes one number, how near the hand was to the target on the whole, some seconds later. Some
segments it never scores. What was lost on the way, because the recorder was started again, it
publishes once more. Started again itself, it goes on behind its last number.
"""

import argparse
import sys
import time
from collections import defaultdict
from collections.abc import Callable

import numpy as np
import rclpy
from arm import nearness
from codetr_msgs import msg
from codetr_msgs.srv import FetchPhase
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from codetr_ros.bags.definitions import decode
from codetr_ros.config import Settings, from_canonical
from codetr_ros.records import Commit, CompositeReward
from codetr_ros.records.fields import type_name
from codetr_ros.ros import qos
from codetr_ros.ros.fetch import unpack
from codetr_ros.ros.signing import Signed


class Inspection(Node):
    """Scores segments.

    Args:
        late: seconds that a score takes, at the most.
        missing: share of segments that are never scored.
        seed: of both.
    """

    def __init__(self, late: float, missing: float, seed: int) -> None:
        super().__init__('inspection')
        self._late, self._missing = late, missing
        self._luck = np.random.default_rng(seed)
        self._settings: Settings | None = None
        self._steps: defaultdict[int, list[float]] = defaultdict(list)  # nearness, by episode
        self._scored: defaultdict[int, int] = defaultdict(int)  # steps that have had their score
        self._waiting: list[tuple[float, msg.CompositeReward]] = []  # in order of their time
        self._sequence = self.skipped = self.missed = 0
        self._known = False  # whether _sequence is behind all that the recorder has
        self._ask_again = 0.0  # when
        self._open: list[msg.CompositeReward] = []  # that no commit has named
        self._before = 0  # scores that had been published when the last commit came
        self.create_subscription(msg.RunSpec, 'run', self._run, qos.profile('run'))
        self.create_timer(0.05, self._publish)

    def _run(self, run: msg.RunSpec) -> None:
        if self._settings is not None:
            return
        settings = self._settings = from_canonical(run.settings, 'the run')
        self._run_id = run.run_id
        self._recorder = self.create_client(FetchPhase, 'fetch_phase')
        topic = 'composite_rewards'
        self._publish_score = Signed(  # with the key of the run, where there is one
            self, msg.CompositeReward, topic, qos.profile(topic, settings)
        )
        self.create_subscription(
            msg.Transitions, 'transitions', self._look, qos.profile('transitions', settings)
        )
        self.create_subscription(
            msg.Commit, 'commits', self._committed, qos.profile('commits', settings)
        )

    def _go_on(self) -> None:
        """Ask the recorder for the scores that a process of this name has published before: the
        next one gets the number behind them. A number that comes twice is dropped.
        """
        now = time.monotonic()
        if now < self._ask_again or not self._recorder.service_is_ready():
            return
        self._ask_again = now + 5.0
        self._ask(FetchPhase.Request.NEWEST, Commit, self._newest)

    def _ask(self, phase: int, kind: type, answered: Callable[..., None]) -> None:
        request = FetchPhase.Request(
            run_id=self._run_id,
            phase=phase,
            requester=self.get_fully_qualified_name(),
            kinds=[type_name(kind)],
        )
        future = self._recorder.call_async(request)
        future.add_done_callback(lambda done: answered(done.result()))

    def _newest(self, answer: FetchPhase.Response) -> None:
        for _, data in unpack(answer):
            self._number_behind(decode(Commit, data))
        phase = answer.phase + 1 if answer.found else 0
        self._ask(phase, CompositeReward, self._under_way)

    def _number_behind(self, commit: Commit) -> None:
        if self.get_name() in commit.scorers:
            last = int(commit.scores[commit.scorers.index(self.get_name())])
            self._sequence = max(self._sequence, last + 1)

    def _under_way(self, answer: FetchPhase.Response) -> None:
        scores = [decode(CompositeReward, data) for _, data in unpack(answer)]
        own = [score.sequence for score in scores if score.scorer == self.get_name()]
        self._sequence = self._before = max([self._sequence - 1, *own]) + 1
        self._known = True

    def _committed(self, commit: msg.Commit) -> None:
        """A commit names what has reached the recorder: publish again what was lost before."""
        named = dict(zip(commit.scorers, commit.scores, strict=True)).get(self.get_name(), -1)
        self._open = [score for score in self._open if score.sequence > named]
        for score in self._open:
            if score.sequence < self._before:
                self._publish_score(score)
        self._before = self._sequence

    def _look(self, steps: msg.Transitions) -> None:
        settings = self._settings
        assert settings is not None
        seen = np.asarray(steps.observations, np.float64).reshape(steps.steps + 1, -1)
        near = self._steps[steps.episode]
        if steps.first_step != len(near):  # it was not there when the episode began
            del self._steps[steps.episode]
            self.missed += 1
            return
        near += nearness(seen[1:, :2]).tolist()  # the first two are shoulder and elbow
        over = steps.terminated or steps.truncated
        length = settings.lengths.most or len(near)
        while len(near) - self._scored[steps.episode] >= (length if not over else 1):
            first = self._scored[steps.episode]
            part = near[first : first + length]
            self._scored[steps.episode] += len(part)
            self._score(steps, first, part)
        if over:
            del self._steps[steps.episode], self._scored[steps.episode]

    def _score(self, steps: msg.Transitions, first: int, part: list[float]) -> None:
        if self._luck.random() < self._missing:
            self.skipped += 1
            return
        score = msg.CompositeReward(
            run_id=self._run_id,
            source=steps.source,
            scorer=self.get_name(),
            episode=steps.episode,
            first_step=first,
            length=len(part),
            value=sum(part),
        )
        self._waiting.append((time.monotonic() + self._late * self._luck.random(), score))

    def _publish(self) -> None:
        """Publish the scores whose time has come, numbered in the order in which they go out."""
        if not self._known:
            if self._settings is not None:
                self._go_on()
            return
        now = time.monotonic()
        for due, score in [each for each in self._waiting if each[0] <= now]:
            self._waiting.remove((due, score))
            score.sequence, self._sequence = self._sequence, self._sequence + 1
            self._publish_score(score)
            self._open.append(score)


def main() -> None:
    """Score until somebody stops it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--late', type=float, default=2.0, help='seconds, at the most')
    parser.add_argument('--missing', type=float, default=0.1, help='share of segments')
    parser.add_argument('--seed', type=int, default=0)
    given, others = parser.parse_known_args()
    rclpy.init(args=[sys.argv[0], *others])
    node = Inspection(given.late, given.missing, given.seed)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == '__main__':
    main()
