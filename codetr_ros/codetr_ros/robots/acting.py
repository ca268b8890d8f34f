"""Drives a robot by a trained policy: without a run, a learner, or anything that is recorded."""

import sys
import time
from collections.abc import Callable

from codetr_ros.policy.plain import PlainPolicy
from codetr_ros.records import F32
from codetr_ros.robots.driving import Driving
from codetr_ros.robots.guard import Hold
from codetr_ros.robots.mapping import Mapping
from codetr_ros.robots.policy_file import PolicyFile
from codetr_ros.robots.steplog import StepLog


class Trained:
    """A trained policy in the place of one that learns: it always acts."""

    def __init__(self, policy: PlainPolicy) -> None:
        self._policy = policy

    def withheld(self) -> Hold | None:
        """Nothing withholds it."""
        return None

    def act(self, observation: F32, step: int) -> F32:
        """The action (A,) in [-1, 1] for an observation (O,) at a step of an episode."""
        return self._policy.act(observation, step)


def without_learner(rules: Mapping) -> Mapping:
    """The mapping without the watch over a learner, of which there is none."""
    live = rules.live
    assert live is not None
    watchdog = live.watchdog.model_copy(update={'learner': 0.0})
    return rules.model_copy(update={'live': live.model_copy(update={'watchdog': watchdog})})


def driving(
    file: PolicyFile, rules: Mapping, clock: Callable[[], float] = time.monotonic
) -> Driving:
    """What drives a robot by the policy of a file.

    Args:
        file: of the policy.
        rules: the mapping of the robot; its part `live` must be there.
        clock: seconds, never going back.
    """
    # its steps are counted and given to nobody; they belong to one endless phase
    log = StepLog(file.described.run_id, rules.source, lambda phase: sys.maxsize)
    return Driving(without_learner(rules), Trained(file.policy), log, clock)
