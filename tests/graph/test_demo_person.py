"""`codetr demo person`: all nodes, a simulated person over topics, and two pages."""

import urllib.request

import pytest

from codetr_ros.bags.reader import Bag
from codetr_ros.bags.verify import verify
from codetr_ros.records import CompositeReward, ScoreRequest
from helpers.judging import CODETR, Command, desk_of, held, summary_of
from helpers.nodes import domain


@pytest.mark.slow
def test_the_demo_serves_both_pages_and_ends_by_itself_with_who_taught(tmp_path):
    out = tmp_path / 'run'
    words = (*CODETR, 'demo', 'person', '--no-open', '--steps', '3000', '--out', str(out))
    with domain(), Command(words) as demo:
        score = demo.until(r'score as you at (http\S+)')[1]
        watch = demo.until(r'watch \S+ at (http\S+)')[1]
        with held(demo, out):
            assert desk_of(score)['scorer'] == 'you'
            with urllib.request.urlopen(watch, timeout=60) as page:
                assert b'<h1' in page.read()
        code = demo.end()
    assert code == 0, demo.text
    records = [entry.record for entry in Bag(out / 'bag').entries()]
    scores = [r for r in records if isinstance(r, CompositeReward)]
    assert {r.scorer for r in scores} == {'person'}
    assert any(isinstance(r, ScoreRequest) for r in records)
    assert f'{len(scores)} scores' in demo.text
    assert 'scores were learnt from' in demo.text and str(out / 'report.html') in demo.text
    assert summary_of(out)['lost'] == 0
    assert verify(out / 'bag').sound
