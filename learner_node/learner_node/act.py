"""`ros2 run learner_node act`: drives a robot by a trained policy, without a run and torch."""

import sys

from codetr_ros.ros.signals import Stop


def main(argv: list[str] | None = None) -> int:
    """Entry point; the imports follow the signal handlers, since they take a while."""
    stop = Stop().install(starting=True)
    from codetr_ros.ros.act import run_act

    return run_act(argv, stop)


if __name__ == '__main__':
    sys.exit(main())
