"""The command `codetr`. Everything slow to import is imported by the command that needs it."""

import sys
from collections.abc import Callable, Iterable, Mapping, Sequence

USAGE = 2
"""Exit code for what the user can correct on the command line, the same as argparse's."""
FAILED = 1
INTERRUPTED = 130
"""Exit code after Ctrl-C, the same as in shells: 128 + SIGINT."""

HELP = """usage: codetr COMMAND [OPTIONS]

Learn a task from composite delayed rewards, with ROS 2 nodes or in one process.

commands:
  train      train on a task: starts all nodes, shows progress, ends with a report
  fit        fit a reward model to bags, without any node
  label      write a bag with a reward model's step rewards added
  convert    make a bag for `fit` from ordinary topics, by a mapping file
  report     make the report of a run, however it was started, or of a benchmark
  watch      show a run in the browser, while it lasts or later
  score      score the segments of a run in the browser
  evaluate   evaluate the policy of a run's newest checkpoint
  export     write the policy of a robot's run into a file to act by
  replay     derive a run's weights again from its bag, and compare them
  benchmark  do many runs under one protocol, and make a table of them
  bag        show, check, recover or play a bag
  demo       a whole example in one command: a robot in real time
  tasks      list the tasks that have a name
  simtest    simulate whole runs in which messages, disks and nodes fail
  doctor     check Python, ROS, discovery, shared memory, torch and MuJoCo

`codetr COMMAND --help` explains the options of a command (of `train` and `fit` the settings that
people change most; `--help-all` explains all); `codetr --version` prints the version.
"""


def _train(arguments: Sequence[str]) -> int:
    from codetr_ros.cli import train

    return train.main(arguments)


def _fit(arguments: Sequence[str]) -> int:
    from codetr_ros.cli import fit

    return fit.main(arguments)


def _label(arguments: Sequence[str]) -> int:
    from codetr_ros.cli import label

    return label.main(arguments)


def _convert(arguments: Sequence[str]) -> int:
    from codetr_ros.cli import convert

    return convert.main(arguments)


def _evaluate(arguments: Sequence[str]) -> int:
    from codetr_ros.cli import evaluate

    return evaluate.main(arguments)


def _export(arguments: Sequence[str]) -> int:
    from codetr_ros.cli import export

    return export.main(arguments)


def _report(arguments: Sequence[str]) -> int:
    from codetr_ros.cli import report

    return report.main(arguments)


def _score(arguments: Sequence[str]) -> int:
    from codetr_ros.cli import score

    return score.main(arguments)


def _watch(arguments: Sequence[str]) -> int:
    from codetr_ros.cli import watch

    return watch.main(arguments)


def _replay(arguments: Sequence[str]) -> int:
    from codetr_ros.cli import replay

    return replay.main(arguments)


def _benchmark(arguments: Sequence[str]) -> int:
    from codetr_ros.cli import benchmark

    return benchmark.main(arguments)


def _bag(arguments: Sequence[str]) -> int:
    from codetr_ros.cli import bag

    return bag.main(arguments)


def _demo(arguments: Sequence[str]) -> int:
    from codetr_ros.cli import demo

    return demo.main(arguments)


def _tasks(arguments: Sequence[str]) -> int:
    from codetr_ros.cli import list_tasks

    return list_tasks.main(arguments)


def _simtest(arguments: Sequence[str]) -> int:
    from codetr_ros.cli import simtest

    return simtest.main(arguments)


def _doctor(arguments: Sequence[str]) -> int:
    from codetr_ros.cli import doctor

    return doctor.main(arguments)


COMMANDS: dict[str, Callable[[Sequence[str]], int]] = {
    'train': _train,
    'fit': _fit,
    'label': _label,
    'convert': _convert,
    'evaluate': _evaluate,
    'export': _export,
    'report': _report,
    'watch': _watch,
    'replay': _replay,
    'score': _score,
    'benchmark': _benchmark,
    'bag': _bag,
    'demo': _demo,
    'tasks': _tasks,
    'simtest': _simtest,
    'doctor': _doctor,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: without the program's name; by default those of this process.

    Returns:
        The exit code: 0 done, 1 failed, 2 refused, 130 interrupted.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    if not given or given[0] in ('-h', '--help', 'help'):
        # The help is the output if it was asked for, and the complaint if it was not.
        print(HELP, end='', file=sys.stdout if given else sys.stderr)
        return 0 if given else USAGE
    if given[0] == '--version':
        from codetr_ros.system.versions import version_of

        print(f'codetr {version_of("codetr_ros") or "of unknown version: it is not installed"}')
        return 0
    command = COMMANDS.get(given[0])
    if command is None and given[0].startswith('-'):
        from codetr_ros.system.similar import did_you_mean

        close = did_you_mean(given[0], ('--help', '--version'))
        return refuse(
            f'there is no option {given[0]!r}{close} in front of a command: '
            f'commands are {", ".join(COMMANDS)}'
        )
    if command is None:
        return refuse_command(given[0], given[0], COMMANDS)
    try:
        return command(given[1:])
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:
        # The reader of our output (`| head`) has gone, so there is nobody to report to. Without
        # this, the interpreter complains once more when it flushes at exit.
        sys.stdout = None
        return FAILED
    except OSError as error:
        if error.filename is None:
            raise
        from codetr_ros.system.files import FileError, remedy

        own = isinstance(error, FileError)
        text = f'{error.filename}: {error.strerror}. {remedy(error).capitalize()}'
        print(f'codetr: {error if own else text}', file=sys.stderr)
        return FAILED


def carry_out_one_of(
    group: str,
    help_text: str,
    commands: Mapping[str, Callable[[Sequence[str]], int]],
    arguments: Sequence[str],
) -> int:
    """Carry out a command of a group, such as `bag info`; returns the exit code.

    Args:
        group: the name of the group.
        help_text: lists its commands.
        commands: each by its name.
        arguments: the command, and what it is given.
    """
    if not arguments:
        print(help_text, end='', file=sys.stderr)
        return USAGE
    if arguments[0] in ('-h', '--help', 'help'):
        print(help_text, end='')
        raise SystemExit(0)  # as after --help of the other commands
    command = commands.get(arguments[0])
    if command is None:
        return refuse_command(f'{group} {arguments[0]}', arguments[0], commands)
    return command(arguments[1:])


def refuse_command(shown: str, given: str, known: Iterable[str]) -> int:
    """Print that there is no such command, and which is close; returns the exit code.

    Args:
        shown: the command as it was typed, with those that it belongs to.
        given: its own name.
        known: the names that there are.
    """
    from codetr_ros.system.similar import did_you_mean

    names = list(known)
    close = did_you_mean(given, names)
    return refuse(f'there is no command {shown!r}{close}: commands are {", ".join(names)}')


def refuse(text: str) -> int:
    """Print why a command was refused; returns the exit code."""
    print(f'codetr: {text}', file=sys.stderr)
    return USAGE
