"""A program that scores segments through ROS services: the frame of a vision model, say.

    .venv/bin/python examples/scorer/scorer.py --token TOKEN --ros-args -r __ns:=/run_1

It asks which segments are worth most, judges each by what the robot saw and did, and hands the
score over; the run numbers it, signs it and learns from it. It needs `codetr_msgs` and nothing
else of this project. Put your model into `judge`.
"""

import argparse
import sys
import time
from typing import Any

import numpy as np
import rclpy
from codetr_msgs.srv import ScoreSegment, WantedSegments
from rclpy.node import Node

LOWEST, HIGHEST = 0.0, 10.0  # this scorer's own scale: any other does as well
PATIENCE = 60.0  # [s] for an answer
PAUSE = 0.5  # [s] when nothing waits


def judge(observations: Any, actions: Any) -> tuple[float | None, str]:
    """Judge one segment: replace this by your model.

    Here, an arm (Reacher-v5) shall bring its finger to a target; the last two numbers of an
    observation are the way between them [m].

    Args:
        observations: (n, O) what the robot saw before each action.
        actions: (n, A) what it did.

    Returns:
        The score, None where it cannot be told, and why.
    """
    if not np.isfinite(observations).all():
        return None, 'a sensor failed'
    away = float(np.linalg.norm(observations[:, -2:], axis=1).mean())
    effort = float(np.square(actions).sum(1).mean())
    score = float(np.clip(HIGHEST - 30 * away - effort, LOWEST, HIGHEST))
    return score, f'{away:.2f} m away'


class Scorer:
    """Calls the services of a run.

    Args:
        node: in the namespace of the run.
        name: of this scorer.
        token: as `codetr score --service` or `codetr train --score-service` prints it.
    """

    def __init__(self, node: Node, name: str, token: str) -> None:
        self._node = node
        self._who = {'scorer': name, 'token': token}
        self._wanted = node.create_client(WantedSegments, 'wanted_segments')
        self._score = node.create_client(ScoreSegment, 'score_segment')

    def call(self, client: Any, **request: Any) -> Any:
        """Call a service; its answer.

        Raises:
            TimeoutError: nobody serves, or answers.
            ValueError: it refuses what is asked.
        """
        if not client.wait_for_service(PATIENCE):
            raise TimeoutError(f'nobody serves {client.srv_name}')
        future = client.call_async(client.srv_type.Request(**self._who, **request))
        rclpy.spin_until_future_complete(self._node, future, timeout_sec=PATIENCE)
        if not future.done():
            raise TimeoutError(f'{client.srv_name} does not answer')
        answer = future.result()
        if not answer.accepted:
            raise ValueError(answer.message)
        return answer

    def run(self) -> int:
        """Score what is wanted until the run has ended; returns how many scores it took."""
        self.call(self._wanted, most=1)
        print(f'scores what {self._wanted.srv_name} names', flush=True)
        while True:
            wanted = self.call(self._wanted, most=1, steps=True)
            if wanted.finished:
                return wanted.taken + 1
            if not wanted.sources:
                time.sleep(PAUSE)
                continue
            observations = np.asarray(wanted.observations).reshape(-1, wanted.observation_size)
            actions = np.asarray(wanted.actions).reshape(-1, wanted.action_size)
            score, why = judge(observations, actions)
            segment = {
                'source': wanted.sources[0],
                'episode': wanted.episodes[0],
                'first_step': wanted.first_steps[0],
                'length': wanted.lengths[0],
            }
            self._give(segment, score, why)

    def _give(self, segment: dict[str, Any], score: float | None, why: str) -> None:
        try:
            answer = self.call(
                self._score,
                **segment,
                value=0.0 if score is None else score,
                cannot_tell=score is None,
                lowest=LOWEST,
                highest=HIGHEST,
                reason=why,
            )
            print(f'{segment}: {score} ({why}); {answer.message}')
        except ValueError as refused:  # the run may have ended meanwhile, or forgotten the steps
            print(f'{segment}: refused: {refused}', file=sys.stderr)
            time.sleep(PAUSE)


def main() -> int:
    """Score until the run has ended; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--name', default='vision')
    parser.add_argument('--token', default='', help='as it was printed where the run was started')
    given, others = parser.parse_known_args()
    rclpy.init(args=[sys.argv[0], *others])
    node = rclpy.create_node('scorer')
    try:
        taken = Scorer(node, given.name, given.token).run()
        print(f'the run has ended: it took {taken} judgements of {given.name!r}')
        return 0
    except (TimeoutError, ValueError) as error:
        print(error, file=sys.stderr)
        return 1
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == '__main__':
    sys.exit(main())
