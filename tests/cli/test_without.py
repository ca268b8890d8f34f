"""Which nodes the run of `codetr train` can do without."""

from dataclasses import dataclass

import pytest

from codetr_ros.cli.train_over_topics import _can_do_without
from codetr_ros.processes.launcher import Command, Node
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs import reports
from codetr_ros.runs.reports import NodeReport
from codetr_ros.runs.summary import Summary
from helpers.builders import tiny


@dataclass
class Program:
    """A process that runs, or has ended with a code."""

    code: int | None = None
    pid: int = 0

    def poll(self) -> int | None:
        return self.code

    def wait(self, timeout: float | None = None) -> int:
        raise NotImplementedError


@pytest.mark.parametrize(
    ('role', 'code', 'recorded', 'dispensable'),
    [
        ('sim', None, True, True),
        ('sim', None, False, False),
        ('sim', 1, True, False),
        ('learner', None, True, False),
        ('evaluate', None, False, True),
    ],
)
def test_a_simulator_that_does_not_end_is_not_needed_once_the_recorder_has_finished(
    role, code, recorded, dispensable, tmp_path
):
    path = run_folder.report_path(tmp_path, 'record', 'record')
    path.parent.mkdir()
    reports.write(path, NodeReport(role='record', name='record', finished=recorded))
    node = Node(Command(role, role, ()), Program(code), tmp_path / 'log')
    summary = Summary(tiny(), 'run', in_process=False)
    assert _can_do_without(node, summary, tmp_path) == dispensable
