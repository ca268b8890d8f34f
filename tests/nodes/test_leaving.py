"""How a node has left a run, by the report that it has left behind."""

from pathlib import Path

import pytest

from codetr_ros.nodes.leaving import forget_report, take_reports
from codetr_ros.nodes.peers import Peers
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs import reports
from codetr_ros.runs.reports import CoreReport, node_report
from codetr_ros.system.liveness import own_name
from helpers.builders import presence

ENDED = f'{own_name()}0'  # a process of this number that began at another time


def leave_report(folder: Path, role: str, error: str | None) -> None:
    nothing = {'published': {}, 'received': {}, 'refused': {}, 'cpu_s': 0.0, 'wall_s': 0.0}
    facts = {'role': role, 'name': role, 'finished': False, 'error': error}
    report = node_report(CoreReport(), **nothing, **facts)
    reports.write(run_folder.report_path(folder, role, role), report)


@pytest.fixture
def peers():
    """Two nodes whose processes are gone, and nothing was received of their ends."""
    made = Peers('record')
    for role in ('sim', 'learner'):
        made.note(presence(role, instance_id=f'{role} {ENDED}'), 0.0)
    assert made.failed() == ['sim /r/sim has died', 'learner /r/learner has died']
    return made


def test_who_was_stopped_has_not_died_although_its_last_presence_was_lost(peers, tmp_path):
    leave_report(tmp_path, 'sim', None)
    take_reports(peers, tmp_path, 1.0)
    assert peers.failed() == ['learner /r/learner has died']
    leave_report(tmp_path, 'learner', None)
    take_reports(peers, tmp_path, 1.0)
    assert peers.failed() == []


def test_who_has_given_up_is_named_with_its_reason(peers, tmp_path):
    leave_report(tmp_path, 'sim', None)
    leave_report(tmp_path, 'learner', 'the disk is full')
    take_reports(peers, tmp_path, 1.0)
    assert peers.failed() == ['learner /r/learner has given up (the disk is full)']


def test_the_report_of_an_earlier_process_is_forgotten_when_a_node_begins(peers, tmp_path):
    leave_report(tmp_path, 'sim', None)
    leave_report(tmp_path, 'learner', None)
    forget_report(tmp_path, 'sim', '/r/sim')
    take_reports(peers, tmp_path, 1.0)
    assert peers.failed() == ['sim /r/sim has died']
