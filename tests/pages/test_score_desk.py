"""The desk behind the page to score: numbers, what waits, and a whole run."""

import numpy as np

from codetr_ros.cores import in_process
from codetr_ros.cores.scoring import Desk
from codetr_ros.records import Commit, CompositeReward
from helpers.builders import commit, tiny
from helpers.score_page import a_desk


def test_who_comes_back_goes_on_with_the_number_after_those_that_a_commit_names():
    desk = a_desk()
    desk.receive(commit(scorers=('ann', 'ben'), scores=np.array([6, 2], np.int64)))
    assert desk.score(('sim', 0, 35, 7), 3).record.sequence == 7


def test_where_nobody_asks_the_newest_segments_are_offered_and_judged_ones_are_not():
    desk = a_desk(asked=0)
    assert desk.waiting()[0] == ('sim', 0, 63, 7)
    desk.score(('sim', 0, 63, 7), 3)
    assert desk.waiting()[0] == ('sim', 0, 56, 7)


def test_a_person_at_a_desk_teaches_a_run():
    """The whole loop in process: the desk scores what waits while the run goes on."""
    settings = tiny(scorer='person', method='evidence', task='InvertedPendulum-v5', delay=10)
    desks, records = [], []

    def sit_down(run_spec, settled):
        desks.append(Desk(run_spec, settled, 'ann'))
        return desks[0]

    def observe(record):
        records.append(record)
        if isinstance(record, Commit) and not desks[0].finished:
            for segment in desks[0].waiting()[:5]:
                desks[0].score(segment, float(segment[3]))

    in_process.run(settings, 'run', None, observe, scorer=sit_down)
    last = [r for r in records if isinstance(r, Commit)][-1]
    assert last.scorers == ('ann',) and last.scores[0] >= 20
    taken = [r for r in records if isinstance(r, CompositeReward)]
    assert desks[0].report().counters == {
        'judgements': len(taken),
        'judgements that no commit took': len(taken) - 1 - int(last.scores[0]),
    }
