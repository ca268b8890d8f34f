"""Who is left out of a run shows in the terminal, the summary and the status."""

import io
import json

import numpy as np

from codetr_ros.runs.leavers import Leavers
from codetr_ros.runs.live import Live
from codetr_ros.runs.progress import Progress
from codetr_ros.runs.report_text import result_rows
from codetr_ros.runs.summary import Summary
from helpers.builders import commit, tiny

BOTH = ('sim', 'sim_2')
SETTINGS = tiny(simulators=2)


def commits():
    dropped = [(), ('sim_2',), ('sim_2',), ()]
    return [
        commit(phase=k, sources=BOTH, transitions=np.array([k, k], np.int64), dropped=out)
        for k, out in enumerate(dropped)
    ]


def test_phases_are_counted_once_however_often_and_late_their_commits_come():
    leavers = Leavers()
    zero, one, two, three = commits()
    assert leavers.receive(zero) == []
    assert leavers.receive(two) == ['sim_2 is left out from phase 2 on: it is not there']
    assert leavers.now() == 'sim_2 (since phase 2)'
    assert leavers.receive(one) == leavers.receive(two) == []
    assert leavers.receive(three) == ['sim_2 is there again']
    assert (leavers.now(), leavers.phases) == ('', {'sim_2': 2})


def test_the_terminal_and_the_status_show_who_is_left_out_and_the_summary_how_long(tmp_path):
    stream = io.StringIO()
    progress = Progress(SETTINGS, stream, live=False, clock=lambda: 0.0)
    summary = Summary(SETTINGS, 'run', in_process=False)
    live = Live(tmp_path, summary, progress, clock=lambda: 0.0)
    for each in commits()[:3]:
        progress.receive(each)
        summary.receive(each)
    assert ('left out', 'sim_2 (since phase 1)') in progress._facts()
    assert 'sim_2 is left out from phase 1 on' in stream.getvalue()
    assert live.status('running', None)['left_out'] == {'sim_2': 1}
    built = summary.build({})
    assert json.loads(built.model_dump_json())['left_out'] == {'sim_2': 2}
    assert ('left out, as nothing came from them', 'sim_2: 2 phases') in result_rows(built)
    summary = Summary(SETTINGS, 'run', in_process=False)
    assert not any('left out' in name for name, _ in result_rows(summary.build({})))
