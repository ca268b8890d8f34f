"""Errors of nodes, and which errors need no traceback to be understood."""


class NodeError(RuntimeError):
    """The node cannot go on: the message names the obstacle and the remedy.

    Attributes:
        cause: why another node gave up, on which this one has waited; empty if the obstacle is
            its own.

    Args:
        message: the obstacle and the remedy.
        cause: see above.
    """

    def __init__(self, message: str, cause: str = '') -> None:
        super().__init__(message)
        self.cause = cause


def first_cause(error: BaseException | str, who: str) -> str:
    """Why a node gives up, for those that wait for it: what was first in a chain of nodes that
    gave up because another one did.

    Args:
        error: of the node; or in words.
        who: its role and full name.
    """
    cause = error.cause if isinstance(error, NodeError) else ''
    words = error if isinstance(error, str) else in_words(error)
    named = words.startswith(f'{who.rpartition(" ")[2]} ')
    return cause or (words if named else f'{who}: {words}')


def explains_itself(error: BaseException) -> bool:
    """Whether an error was raised to be read. Each subsystem of this package has an error class of
    its own, whose message names value, source and remedy. Any other error is a fault of the
    program, and only its traceback shows where.
    """
    return any(kind.__module__.split('.')[0] == 'codetr_ros' for kind in type(error).__mro__)


def in_words(error: BaseException) -> str:
    """An error in one line or a few, for reports."""
    return str(error) if explains_itself(error) else f'{type(error).__name__}: {error}'
