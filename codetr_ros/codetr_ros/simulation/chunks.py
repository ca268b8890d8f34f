"""How many steps of an episode go into one message."""

from codetr_ros.records import MESSAGE_BYTES
from codetr_ros.simulation.environments import Environment, TaskError

CHUNK_STEPS = 250
"""The most steps of a chunk: bounds the time of an environment's part of a slice of work."""


def chunk_steps(observation_size: int, action_size: int) -> int:
    """The most steps T of a chunk such that (T+1, O) and (T, A) float32 fit; 0 if no step fits."""
    numbers = MESSAGE_BYTES // 4
    fitting = (numbers - observation_size) // (observation_size + action_size)
    return max(0, min(CHUNK_STEPS, fitting))


def steps_of_chunks(environment: Environment) -> int:
    """The most steps of a chunk of this environment.

    Raises:
        TaskError: not even one step fits into a message.
    """
    sizes = environment.observation_size, environment.action_size
    steps = chunk_steps(*sizes)
    if not steps:
        raise TaskError(
            f'task {environment.name!r}: one step with {sizes[0]} observations and {sizes[1]} '
            f'actions takes more than the {MESSAGE_BYTES} bytes of a message: choose a task with '
            'smaller observations'
        )
    return steps
