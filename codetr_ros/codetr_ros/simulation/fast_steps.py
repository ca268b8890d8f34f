"""Steps of Gymnasium's MuJoCo environments without what nobody here reads.

Around the physics these environments make dictionaries, copies and sums for people, ask the model
for its time step and compute forces that few observations have: where the physics is small, that
takes a quarter of the time again. Here observation, reward and termination come straight from the
arrays in which MuJoCo keeps its state. Every bit is Gymnasium's (a test holds each task to it):
where rounding depends on the order, the type or the function of an operation, it is the same.

Only environments that Gymnasium registers and that are made without arguments are stepped so; any
other steps itself.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from codetr_ros.records import F32

_MODULE = 'gymnasium.envs.mujoco.'


def stepper(env: Any) -> 'Stepper | None':
    """What steps an environment (without wrappers) faster than itself, if anything does."""
    spec = env.spec
    if spec is None or spec.kwargs:
        return None
    make = STEPPERS.get(str(spec.entry_point))
    return None if make is None else make(env)


class Stepper(ABC):
    """Steps one environment, which nothing else may step; reset it as ever.

    Args:
        env: the environment, without wrappers.
    """

    def __init__(self, env: Any) -> None:
        data = env.data
        self._ctrl: NDArray[np.float64] = data.ctrl
        # views of the state, which MuJoCo updates in place
        self._positions: NDArray[np.float64] = data.qpos
        self._velocities: NDArray[np.float64] = data.qvel
        self._size = math.prod(env.observation_space.shape)
        self._advance = partial(mujoco.mj_step, env.model, data, env.frame_skip)

    @abstractmethod
    def step(self, action: NDArray[np.float32]) -> tuple[F32, float, bool]:
        """Take an action (A,) within the environment's bounds.

        Returns:
            The observation (O,), which is the caller's own, the reward, and whether a terminal
            state was reached.
        """

    def _simulate(self, action: NDArray[np.float32]) -> None:
        self._ctrl[...] = action
        self._advance()


class Runner(Stepper):
    """Earns its speed along x, less the cost of its actions: HalfCheetah, Swimmer.

    Args:
        env: the environment.
        unseen: leading positions that are not observed.
    """

    def __init__(self, env: Any, unseen: int) -> None:
        super().__init__(env)
        self._seen = self._positions[unseen:]
        self._place = self._positions  # its first number is the x of which the speed is taken
        self._period = env.dt
        self._forward_weight = getattr(env, '_forward_reward_weight', 1.0)  # Ant has none
        self._control_weight = env._ctrl_cost_weight  # noqa: SLF001

    def step(self, action: NDArray[np.float32]) -> tuple[F32, float, bool]:
        """One step, as in `Stepper`."""
        forward, cost = self._run(action)
        return self._observe(), forward - cost, False

    def _run(self, action: NDArray[np.float32]) -> tuple[float, float]:
        """Simulate; what speed earns and what the action costs."""
        before = self._place.item(0)
        self._simulate(action)
        speed = (self._place.item(0) - before) / self._period
        # in float32, the type of the action
        cost = float(self._control_weight * np.add.reduce(np.square(action)))
        return self._forward_weight * speed, cost

    def _observe(self) -> F32:
        observation = np.empty(self._size, np.float32)
        split = len(self._seen)
        observation[:split] = self._seen
        observation[split:] = self._velocities
        return observation


class Walker(Runner):
    """A runner that must stay upright, and earns a bonus where it does: Hopper, Walker2d.

    Args:
        env: the environment.
        bonus_at_the_end: whether the step that ends the episode earns the bonus too (v4).
    """

    def __init__(self, env: Any, bonus_at_the_end: bool) -> None:
        super().__init__(env, 1)
        self._least = np.full(len(self._velocities), -10.0, np.float32)
        self._most = -self._least
        self._bonus = env._healthy_reward  # noqa: SLF001
        self._bonus_at_the_end = bonus_at_the_end
        self._heights = env._healthy_z_range  # noqa: SLF001
        self._angles = env._healthy_angle_range  # noqa: SLF001
        # of all of the state but x and height; Walker2d does not look at it
        self._range = getattr(env, '_healthy_state_range', None)

    def step(self, action: NDArray[np.float32]) -> tuple[F32, float, bool]:
        """One step, as in `Stepper`."""
        forward, cost = self._run(action)
        healthy = self._healthy()
        bonus = self._bonus if healthy or self._bonus_at_the_end else 0.0
        return self._observe(), forward + bonus - cost, not healthy

    def _healthy(self) -> bool:
        _, height, *rest = self._positions.tolist()
        (low, high), (least, most) = self._heights, self._angles
        if not (low < height < high and least < rest[0] < most):
            return False
        if self._range is None:
            return True
        rest += self._velocities.tolist()
        lowest, highest = self._range
        return bool(lowest < min(rest) and max(rest) < highest)

    def _observe(self) -> F32:
        observation = super()._observe()
        velocities = observation[len(self._seen) :]
        np.maximum(velocities, self._least, out=velocities)
        np.minimum(velocities, self._most, out=velocities)
        return observation


class Ant(Runner):
    """A runner on four legs whose torso must stay at its height (v4, no contact forces)."""

    def __init__(self, env: Any) -> None:
        super().__init__(env, 2)
        self._place = env.data.body('torso').xpos
        self._bonus = env._healthy_reward  # noqa: SLF001
        self._heights = env._healthy_z_range  # noqa: SLF001

    def step(self, action: NDArray[np.float32]) -> tuple[F32, float, bool]:
        """One step, as in `Stepper`."""
        forward, cost = self._run(action)
        low, high = self._heights
        healthy = low <= self._positions.item(2) <= high
        return self._observe(), forward + self._bonus - cost, not healthy


class Humanoid(Stepper):
    """Earns the speed of its centre of mass along x and a bonus for its height, less the costs of
    its actions and of what it hits.
    """

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        model, data = env.model, env.data
        self._forces = partial(mujoco.mj_rnePostConstraint, model, data)
        self._masses, self._centres = model.body_mass, data.xipos
        self._mass = model.body_mass.sum()
        self._contacts = data.cfrc_ext
        self._period = env.dt
        self._forward_weight = env._forward_reward_weight  # noqa: SLF001
        self._control_weight = env._ctrl_cost_weight  # noqa: SLF001
        self._contact_weight = env._contact_cost_weight  # noqa: SLF001
        self._contact_range = env._contact_cost_range  # noqa: SLF001
        self._bonus = env._healthy_reward  # noqa: SLF001
        self._heights = env._healthy_z_range  # noqa: SLF001
        # of the bodies all but the world's, of the forces those of actuators
        bodies = (data.cinert[1:].reshape(-1), data.cvel[1:].reshape(-1))
        forces = (data.qfrc_actuator[6:], data.cfrc_ext[1:].reshape(-1))
        self._parts = (self._positions[2:], self._velocities, *bodies, *forces)

    def step(self, action: NDArray[np.float32]) -> tuple[F32, float, bool]:
        """One step, as in `Stepper`."""
        before = self._centre()
        self._simulate(action)
        self._forces()
        forward = self._forward_weight * ((self._centre() - before) / self._period)
        low, high = self._heights
        healthy = low < self._positions.item(2) < high
        control = self._control_weight * np.add.reduce(np.square(self._ctrl))
        contact = self._contact_weight * np.add.reduce(np.square(self._contacts), axis=None)
        least, most = self._contact_range
        costs = control + min(max(contact, least), most)
        reward = forward + (self._bonus if healthy else 0.0) - costs
        observation = np.empty(self._size, np.float32)
        np.concatenate(self._parts, out=observation, casting='same_kind')
        return observation, float(reward), not healthy

    def _centre(self) -> float:
        """Where the centre of mass is along x."""
        return float(np.einsum('b,bj->j', self._masses, self._centres)[0] / self._mass)


class InvertedPendulum(Stepper):
    """Earns 1 for each step upright."""

    def step(self, action: NDArray[np.float32]) -> tuple[F32, float, bool]:
        """One step, as in `Stepper`."""
        self._simulate(action)
        observation = np.empty(4, np.float32)
        observation[:2] = self._positions
        observation[2:] = self._velocities
        tipped = abs(self._positions.item(1)) > 0.2
        return observation, float(not tipped), tipped


class InvertedDoublePendulum(Stepper):
    """Earns a bonus for being up, less for where its tip is and how fast it moves."""

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self._tip = env.data.site_xpos[0]
        self._forces = env.data.qfrc_constraint
        self._bonus = env._healthy_reward  # noqa: SLF001

    def step(self, action: NDArray[np.float32]) -> tuple[F32, float, bool]:
        """One step, as in `Stepper`."""
        self._simulate(action)
        x, _, y = self._tip.tolist()
        _, one, two = velocities = self._velocities.tolist()
        fallen = y <= 1
        distance = 0.01 * x**2 + (y - 2) ** 2
        speed = 1e-3 * one**2 + 5e-3 * two**2
        angles = self._positions[1:]
        observation = np.empty(9, np.float32)
        observation[0] = self._positions[0]
        observation[1:3] = np.sin(angles)
        observation[3:5] = np.cos(angles)
        observation[5:] = [
            min(max(value, -10.0), 10.0) for value in (*velocities, self._forces.item(0))
        ]
        return observation, (0.0 if fallen else self._bonus) - distance - speed, fallen


class Reacher(Stepper):
    """Pays for the distance of its finger from the target, and for its actions."""

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self._finger = env.data.body('fingertip').xpos
        self._target = env.data.body('target').xpos
        self._distance_weight = env._reward_dist_weight  # noqa: SLF001
        self._control_weight = env._reward_control_weight  # noqa: SLF001

    def step(self, action: NDArray[np.float32]) -> tuple[F32, float, bool]:
        """One step, as in `Stepper`."""
        self._simulate(action)
        away = self._finger - self._target
        distance = math.sqrt(away.dot(away)) * self._distance_weight
        cost = float(self._control_weight * np.add.reduce(np.square(action)))  # in float32
        angles = self._positions[:2]
        observation = np.empty(10, np.float32)
        observation[:2] = np.cos(angles)
        observation[2:4] = np.sin(angles)
        observation[4:6] = self._positions[2:]
        observation[6:8] = self._velocities[:2]
        observation[8:] = away[:2]
        return observation, -distance - cost, False


STEPPERS: dict[str, Callable[[Any], Stepper]] = {
    f'{_MODULE}half_cheetah_v5:HalfCheetahEnv': partial(Runner, unseen=1),
    f'{_MODULE}half_cheetah_v4:HalfCheetahEnv': partial(Runner, unseen=1),
    f'{_MODULE}swimmer_v5:SwimmerEnv': partial(Runner, unseen=2),
    f'{_MODULE}hopper_v5:HopperEnv': partial(Walker, bonus_at_the_end=False),
    f'{_MODULE}hopper_v4:HopperEnv': partial(Walker, bonus_at_the_end=True),
    f'{_MODULE}walker2d_v5:Walker2dEnv': partial(Walker, bonus_at_the_end=False),
    f'{_MODULE}walker2d_v4:Walker2dEnv': partial(Walker, bonus_at_the_end=True),
    f'{_MODULE}ant_v4:AntEnv': Ant,
    f'{_MODULE}humanoid_v5:HumanoidEnv': Humanoid,
    f'{_MODULE}inverted_pendulum_v5:InvertedPendulumEnv': InvertedPendulum,
    f'{_MODULE}inverted_double_pendulum_v5:InvertedDoublePendulumEnv': InvertedDoublePendulum,
    f'{_MODULE}reacher_v5:ReacherEnv': Reacher,
}
"""What steps an environment, by the entry point under which Gymnasium registers it."""
