"""The tasks by name: their environments, the length of their episodes, and their best reward.

Nothing heavy is imported before a task is made, so that listing and checking names is quick.
"""

import difflib
from typing import Any

from codetr_ros.config import Settings, SettingsError
from codetr_ros.config.schedule import ROBOT
from codetr_ros.simulation.control_suite import ControlSuiteEnvironment
from codetr_ros.simulation.environments import Environment, Task, TaskError
from codetr_ros.simulation.faults import FAULTS, in_words
from codetr_ros.simulation.gymnasium_environment import GymnasiumEnvironment
from codetr_ros.system import modules

__all__ = ['TASKS', 'Environment', 'Task', 'TaskError', 'check', 'find', 'make', 'r_max']


def _gymnasium(name: str, r_max: float, note: str, horizon: int = 1000) -> Task:
    return Task(
        name=name,
        environment_id=name,
        library='gymnasium',
        horizon=horizon,
        r_max=r_max,
        note=note,
    )


def _dm_control(name: str, note: str) -> Task:
    # every reward of the suite lies in [0, 1], and every episode has 1000 control steps (Tassa et
    # al., 2018)
    return Task(
        name=name, environment_id=name, library='dm_control', horizon=1000, r_max=1.0, note=note
    )


# The paper lists no r_max ("maximum possible reward in the environment"). If the reward has no
# bound, r_max is here what good policies reach per step: read scores with that in mind.
_TASKS = (
    # Gym's reward threshold, 6000 in 1000 steps; SAC reaches 5.3 to 6.0
    _gymnasium(
        'Ant-v4', 6.0, "27 observations, no contact forces: stands in for the paper's Ant-v2"
    ),
    # SAC and TD3 after a million steps: 11.3 to 12.1 (Gym's threshold of 4.8 is too low)
    _gymnasium('HalfCheetah-v5', 12.0, 'never terminates'),
    _gymnasium('HalfCheetah-v4', 12.0, 'never terminates; dynamics of v2'),
    # Gym's reward threshold, 3800 in 1000 steps
    _gymnasium('Hopper-v5', 3.8, 'terminates when it falls'),
    _gymnasium('Hopper-v4', 3.8, 'terminates when it falls; dynamics of v2'),
    # SAC and TD3 after a million steps: 4.7 to 5.0
    _gymnasium('Walker2d-v5', 5.0, 'terminates when it falls'),
    _gymnasium('Walker2d-v4', 5.0, 'terminates when it falls; dynamics of v2'),
    # SAC and TD3 after a million steps: 5.1 to 5.5
    _gymnasium('Humanoid-v5', 5.5, 'terminates when it falls; 348 observations'),
    # exactly: 1 for each step upright
    _gymnasium('InvertedPendulum-v5', 1.0, 'terminates when the pole tips'),
    # exactly: 10 for being alive, less (1.2 - 2)^2 with the tip as high as it goes
    _gymnasium(
        'InvertedDoublePendulum-v5', 9.36, 'terminates when the tip sinks; the quickest to learn'
    ),
    # Gym's reward threshold, 360 in 1000 steps
    _gymnasium('Swimmer-v5', 0.36, 'never terminates; hard for a discount of 0.99'),
    # its rewards are costs, never above 0, which cannot be a unit: so 1, and the best score is 0
    _gymnasium('Reacher-v5', 1.0, 'rewards are costs: scores are negative, 0 is best', horizon=50),
    _dm_control('cheetah-run', 'speed up to 10 m/s'),
    _dm_control('walker-walk', 'upright at 1 m/s'),
    _dm_control('walker-run', 'upright at 8 m/s'),
    _dm_control('hopper-hop', 'upright at 2 m/s; hard to explore'),
    _dm_control('quadruped-walk', '78 observations'),
    _dm_control('fish-upright', 'keep upright in water'),
    _dm_control('cartpole-swingup', 'swing up and balance'),
    _dm_control('ball_in_cup-catch', 'sparse reward'),
    _dm_control('reacher-hard', 'sparse reward, small target'),
    _dm_control('finger-spin', 'sparse reward'),
)
TASKS: dict[str, Task] = {task.name: task for task in _TASKS}
"""The tasks with a name of their own; any other Gymnasium id works too, also `module:id`."""


def find(name: str) -> Task:
    """The task of a name. Imports Gymnasium only for names that are not in `TASKS`, and the module
    of a name `module:id`, which registers the environment.

    Raises:
        TaskError: no such task, one without a horizon, or a module that cannot be imported.
    """
    if name in TASKS:
        return TASKS[name]
    if name.startswith(ROBOT):
        raise TaskError(
            f'task {name!r} is that of a robot, which nothing simulates: start the nodes of its '
            'run one by one, as docs/your-robot.md shows, with `ros2 run sim_node robot`'
        )
    import gymnasium

    module = modules.of_task(name)
    environment_id = name if module is None else name.removeprefix(f'{module}:')
    if module is not None:
        _import(name, module)
    try:
        spec = gymnasium.spec(environment_id)
    except (gymnasium.error.Error, ImportError) as error:
        where = '' if module is None else f' in what module {module!r} registers'
        raise TaskError(
            f'there is no task {name!r}{where}{_close_to(environment_id, gymnasium.registry)}. '
            '`codetr tasks` lists the tasks with a name; any Gymnasium id with Box spaces works '
            'as well, and `module:id` imports the module that registers it. '
            f'Error of Gymnasium: {error}'
        ) from None
    steps = spec.max_episode_steps
    if not isinstance(steps, int) or steps < 1:
        raise TaskError(
            f'task {name!r}{_close_to(name, {})} has no horizon, its max_episode_steps is '
            f'{spec.max_episode_steps}: register it with max_episode_steps, or choose a task that '
            '`codetr tasks` lists'
        )
    note = 'r_max is not known: 1.0, unless the setting r_max gives another unit of scores'
    return Task(
        name=name,
        environment_id=environment_id,
        library='gymnasium',
        horizon=steps,
        r_max=1.0,
        note=note,
    )


def _import(name: str, module: str) -> None:
    """Import the module of a task.

    Raises:
        TaskError: there is none of that name, or its code raised an error.
    """
    try:
        modules.load(module)
    except FAULTS as error:
        raise TaskError(
            f'task {name!r}: module {module!r} cannot be imported: {in_words(error)}. '
            'Install it, start from the folder that holds it, or name that folder in PYTHONPATH'
        ) from error


def _close_to(name: str, others: dict[str, Any]) -> str:
    """Close matches among the tasks, for an error; those in `TASKS` first."""
    known = {known.lower(): known for known in [*others, *TASKS]}
    close = [known[match] for match in difflib.get_close_matches(name.lower(), known, n=4)]
    close.sort(key=lambda match: match not in TASKS)
    return f' (close: {", ".join(close)})' if close else ''


def make(name: str) -> Environment:
    """The environment of a task.

    Raises:
        TaskError: no such task, without a horizon or bounds, spaces that are not Box, or not
            installed.
    """
    task = find(name)
    return (
        ControlSuiteEnvironment(task)
        if task.library == 'dm_control'
        else GymnasiumEnvironment(task)
    )


def check(settings: Settings, task: Task | Environment) -> None:
    """Refuse settings that no episode of the task can meet.

    Raises:
        SettingsError: the delay exceeds the horizon, so that no segment would ever be whole.
    """
    if settings.within(task.horizon).longest > task.horizon:
        raise SettingsError(
            f'delay = {settings.delay}: task {task.name!r} has a horizon of {task.horizon} '
            f'steps; choose a delay from 1 to {task.horizon}'
        )


def r_max(settings: Settings, task: Task | Environment) -> float:
    """The largest reward of a step, the unit of scores: from the settings, else from the task."""
    return task.r_max if settings.r_max is None else settings.r_max
