"""Makes the file of a trained policy from what a learner published, with torch as the judge of
what numpy will compute.
"""

from pathlib import Path

import numpy as np

from codetr_ros.config import Settings
from codetr_ros.policy.acting import ActingPolicy
from codetr_ros.policy.network import STANDARDISED, Network, read_network, read_weights
from codetr_ros.policy.plain import PlainPolicy
from codetr_ros.records import F32, Policy
from codetr_ros.robots.policy_file import (
    ACTION,
    FORMAT,
    PolicyFile,
    PolicyFileError,
    canonical,
    load,
    sha256,
    write,
)
from codetr_ros.robots.robot_facts import RobotFacts
from codetr_ros.robots.same_robot import check_sizes
from codetr_ros.system.versions import version_of

COUNT = 16  # examples
TOLERANCE = 1e-5
"""By which an action may differ on another machine: sums in another order, in float32."""
COARSEST = 1e-3
"""The largest tolerance: a policy that amplifies rounding more than that is none to act with."""


def export(policy: Policy, robot: RobotFacts, settings: Settings, path: Path) -> PolicyFile:
    """Write the file of a policy, and read and test it.

    Args:
        policy: what the learner published, or its checkpoint holds.
        robot: the robot that it was trained on.
        settings: of its run.
        path: the file; an existing one is replaced.

    Raises:
        NetworkError: the policy is random, or its weights do not fit its network.
        AnotherRobotError: the robot has other sizes than the policy.
        PolicyFileError: the robot cannot be driven, or numpy does not act as torch does.
        OSError: the file cannot be written.
    """
    name = f'policy of run {policy.run_id!r} after phase {policy.version}'
    network = read_network(policy.network, name)
    o, a = network.observation_size, network.action_size
    acting = ActingPolicy.from_record(policy, o, a, network.segment_steps)
    weights = read_weights(policy.weights, name)
    _check_robot(robot, network, name)
    plain = PlainPolicy(network, weights, name)
    seen, steps = _examples(network, weights)
    pairs = list(zip(seen, steps.tolist(), strict=True))
    actions = np.array([acting.act(observation, step=step) for observation, step in pairs])
    acted = np.array([plain.act(observation, step) for observation, step in pairs])
    apart = float(np.abs(acted - actions).max())
    tolerance = max(TOLERANCE, 4 * apart)
    if not tolerance <= COARSEST:
        raise PolicyFileError(
            f'{name}: the actions of numpy and torch differ by {apart:g}: its weights amplify '
            'rounding. Look at the losses of the run, and train it again'
        )
    mapping = robot.mapping.model_dump(mode='json')
    described = {
        'format': FORMAT,
        'codetr_ros': version_of('codetr_ros'),
        'run_id': policy.run_id,
        'task': settings.task,
        'settings_hash': settings.hash(),
        'phase': policy.version,
        'steps': settings.steps_after(policy.version),
        'network': policy.network,
        'action': ACTION,
        'robot': robot.model_dump(mode='json'),
        'mapping_sha256': sha256(canonical(mapping)),
        'tolerance': tolerance,
    }
    write(path, described, weights, {'observations': seen, 'steps': steps, 'actions': actions})
    made = load(path)
    made.test()
    return made


def _check_robot(robot: RobotFacts, network: Network, name: str) -> None:
    live, action = robot.mapping.live, robot.mapping.action
    if live is None:
        raise PolicyFileError(
            f'{name}: the mapping has no part `live`, without which no robot is driven: '
            'docs/your-robot.md has an example'
        )
    size = live.size(action.low, action.high, len(action.joints or ()))
    if size != network.action_size:
        raise PolicyFileError(
            f'{name} has actions of {network.action_size} numbers, and a command of the mapping '
            f'has {size}: give the mapping of the robot that it was trained on'
        )
    if robot.sizes:
        check_sizes(robot, robot.sizes, network.observation_size, name)


def _examples(
    network: Network, weights: dict[str, F32]
) -> 'tuple[F32, np.ndarray[tuple[int], np.dtype[np.int64]]]':
    """Observations (N, O) of the size that the policy has seen, and steps (N,)."""
    rng = np.random.default_rng(0)
    seen = rng.standard_normal((COUNT, network.observation_size)).astype(np.float32)
    if network.kind == STANDARDISED:
        size = network.observation_size
        mean = weights['observation_mean'][:size]
        seen = mean + seen * weights['observation_deviation'][:size]
    seen[0] = 0
    return seen, rng.integers(0, max(1, network.segment_steps), COUNT)
