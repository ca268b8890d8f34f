"""Errors of nodes, and which errors need no traceback to be understood."""


class NodeError(RuntimeError):
    """The node cannot go on: the message names the obstacle and the remedy."""


def explains_itself(error: BaseException) -> bool:
    """Whether an error was raised to be read. Each subsystem of this package has an error class of
    its own, whose message names value, source and remedy. Any other error is a fault of the
    program, and only its traceback shows where.
    """
    return any(kind.__module__.split('.')[0] == 'codetr_ros' for kind in type(error).__mro__)


def in_words(error: BaseException) -> str:
    """An error in one line or a few, for reports."""
    return str(error) if explains_itself(error) else f'{type(error).__name__}: {error}'
