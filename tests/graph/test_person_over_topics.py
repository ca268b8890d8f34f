"""A person scores over topics, on the page beside `codetr train --scorer person`, on which a
camera that publishes nothing is named.
"""

import pytest

from codetr_ros.bags.verify import verify
from helpers.judging import (
    CODETR,
    Command,
    first_waiting,
    judge_until_taken,
    pictures,
    summary_of,
)
from helpers.nodes import domain

FLAGS = (
    *('--scorer', 'person', '--scorers', 'ann', '--task', 'InvertedPendulum-v5'),
    *('--delay', '10', '--steps', '3000', '--warmup-steps', '1000', '--phase-steps', '500'),
    *('--method', 'evidence', '--evaluate-every', '0', '--no-film', '--camera', '/a/camera'),
)


@pytest.mark.slow
def test_what_a_person_states_on_the_page_is_taken_by_a_commit_and_learnt_from(tmp_path):
    out = tmp_path / 'run'
    with domain(), Command((*CODETR, 'train', *FLAGS, '--out', str(out))) as train:
        url = train.until(r'score as ann at (http\S+)')[1]
        shown = pictures(url, first_waiting(url))
        taken = judge_until_taken(url)
        code = train.end()
    assert code == 0, train.text
    assert taken, 'no commit took what was stated'
    assert shown['frames'] == []
    assert 'nobody publishes pictures on /a/camera yet' in shown['note']
    summary = summary_of(out)
    assert summary['refused'] == summary['lost'] == 0
    assert summary['scorers']['ann']['scores'] > 0
    assert verify(out / 'bag').sound
