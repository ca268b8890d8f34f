"""Processes of a run that a benchmark has started."""

from codetr_ros.processes import launcher


def first_failure(processes: launcher.Processes) -> launcher.Node | None:
    """The first process that has ended with an error without being asked to; None if none has."""
    return next((node for node in processes.nodes if node.unasked_failure), None)


def check(processes: launcher.Processes) -> None:
    """End the benchmark if a process has failed.

    Raises:
        SystemExit: it has: with the end of its log.
    """
    if failed := first_failure(processes):
        raise SystemExit(f'{failed.how_it_ended()}\n{launcher.end_of_log(failed.log)}')
