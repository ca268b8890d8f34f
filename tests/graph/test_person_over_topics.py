"""A person scores over topics, on the page beside `codetr train --scorer person`, on which a
camera that publishes nothing is named.
"""

import pytest

from codetr_ros.bags.verify import verify
from helpers import slow_robots
from helpers.judging import (
    CODETR,
    PATIENCE,
    Command,
    first_waiting,
    judge_until_taken,
    pictures,
    summary_of,
)
from helpers.nodes import domain

FLAGS = (
    *('--scorer', 'person', '--scorers', 'ann', '--task', slow_robots.PENDULUM),
    *('--delay', '10', '--steps', '2400', '--warmup-steps', '400', '--phase-steps', '100'),
    *('--peer-deadline', str(PATIENCE)),
    *('--method', 'evidence', '--evaluate-every', '0', '--no-film', '--camera', '/a/camera'),
)


@pytest.mark.slow
def test_what_a_person_states_on_the_page_is_taken_by_a_commit_and_learnt_from(tmp_path):
    out = tmp_path / 'run'
    held = slow_robots.Held(tmp_path, 0.02)
    words = (*CODETR, 'train', *FLAGS, '--out', str(out))
    with domain(), Command(words, variables=held.variables) as train:
        url = train.until(r'score as ann at (http\S+)')[1]
        shown = pictures(url, first_waiting(url))
        taken = judge_until_taken(url)
        held.let_go()  # before, the run could end while somebody only looks at the page
        code = train.end()
    assert code == 0, train.text
    assert taken, 'no commit took what was stated'
    assert shown['frames'] == []
    assert 'nobody publishes pictures on /a/camera yet' in shown['note']
    summary = summary_of(out)
    assert summary['refused'] == summary['lost'] == 0
    assert summary['scorers']['ann']['scores'] > 0
    assert verify(out / 'bag').sound
