"""An inspection that scores attempts of the stand-in arm: the only node that knows what is good.

    .venv/bin/python examples/robot_arm/inspection.py --ros-args -r __ns:=/my_run

It receives the steps of the run and looks at where the hand was. For each segment that is over it
publishes one number, how near the hand was to the target on the whole, some seconds later. Some
segments it never scores. What was lost on the way, because the recorder was started again, it
publishes once more.
"""

import argparse
import sys
import time
from collections import defaultdict

import numpy as np
import rclpy
from arm import nearness
from codetr_msgs import msg
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from codetr_ros.config import Settings, from_canonical
from codetr_ros.ros import qos
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
        self._sequence = self.skipped = 0
        self._open: list[msg.CompositeReward] = []  # that no commit has named
        self._before = 0  # scores that had been published when the last commit came
        self.create_subscription(msg.RunSpec, 'run', self._run, qos.profile('run'))
        self.create_timer(0.05, self._publish)

    def _run(self, run: msg.RunSpec) -> None:
        if self._settings is not None:
            return
        settings = self._settings = from_canonical(run.settings, 'the run')
        self._run_id = run.run_id
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
