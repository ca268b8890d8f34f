"""A person scores over topics, on the page beside `codetr train --scorer person`."""

import pytest

from codetr_ros.bags.verify import verify
from helpers.judging import CODETR, Command, judge_until_taken, summary_of
from helpers.nodes import domain

FLAGS = (
    *('--scorer', 'person', '--scorers', 'ann', '--task', 'InvertedPendulum-v5'),
    *('--delay', '10', '--steps', '3000', '--warmup-steps', '1000', '--phase-steps', '500'),
    *('--method', 'evidence', '--evaluate-every', '0', '--no-film'),
)


@pytest.mark.slow
def test_what_a_person_states_on_the_page_is_taken_by_a_commit_and_learnt_from(tmp_path):
    out = tmp_path / 'run'
    with domain(), Command((*CODETR, 'train', *FLAGS, '--out', str(out))) as train:
        taken = judge_until_taken(train.until(r'score as ann at (http\S+)')[1])
        code = train.end()
    assert code == 0, train.text
    assert taken, 'no commit took what was stated'
    summary = summary_of(out)
    assert summary['refused'] == summary['lost'] == 0
    assert summary['scorers']['ann']['scores'] > 0
    assert verify(out / 'bag').sound
