"""A program scores a run through services, and who has no key is shown why it cannot."""

import re
import sys
import time
import urllib.error
from pathlib import Path

import pytest
import rclpy
import yaml
from codetr_msgs.srv import ScoreSegment
from rclpy.signals import SignalHandlerOptions

from codetr_ros.bags.reader import Bag
from codetr_ros.bags.verify import verify
from codetr_ros.records import CompositeReward
from helpers import slow_robots
from helpers.judging import CODETR, PATIENCE, Command, desk_of, judge, summary_of
from helpers.nodes import domain

ROOT = Path(__file__).resolve().parents[2]
SCORER = ROOT / 'examples' / 'scorer' / 'scorer.py'
CALL = re.compile(r'ros2 service call \S+ codetr_msgs/srv/ScoreSegment\s+\\?\s*"(\{.*?\})"', re.S)
FLAGS = (
    *('--scorer', 'topic', '--task', slow_robots.REACHER, '--delay', '25', '--score-service'),
    *('--steps', '4000', '--warmup-steps', '1000', '--phase-steps', '500'),
    *('--method', 'evidence', '--evaluate-every', '0', '--no-film', '--sac.hidden', '32', '32'),
    *('--peer-deadline', str(PATIENCE)),
)


def calls() -> list[dict[str, object]]:
    """The requests that the documentation calls the service with."""
    pages = [ROOT / 'docs' / name for name in ('people.md', 'ros.md')]
    return [yaml.safe_load(call) for page in pages for call in CALL.findall(page.read_text())]


def called(namespace: str, request: ScoreSegment.Request) -> ScoreSegment.Response:
    """The answer of the service."""
    arguments = ['caller', '--ros-args', '-r', f'__ns:={namespace}']
    rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node('caller')
    try:
        client = node.create_client(ScoreSegment, 'score_segment')
        assert client.wait_for_service(PATIENCE)
        future = client.call_async(request)
        rclpy.spin_until_future_complete(node, future, timeout_sec=PATIENCE)
        return future.result()
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


def shown_problem(url: str) -> str:
    """What the page shows as its problem, once it does."""
    end = time.monotonic() + PATIENCE
    while (problem := desk_of(url)['problem']) is None:
        assert time.monotonic() < end
    return problem


@pytest.mark.slow
def test_a_program_scores_by_service_and_a_page_without_the_key_takes_nothing(tmp_path):
    out = tmp_path / 'run'
    held = slow_robots.Held(tmp_path, 0.02)
    words = (*CODETR, 'train', *FLAGS, '--out', str(out))
    with domain(), Command(words, held.variables) as train:
        found = train.until(r'scores by service: (\S+)/score_segment, token (\w+)')
        namespace, token = found[1], found[2]
        assert found[0] in train.text
        program = (sys.executable, str(SCORER), '--token', token, '--ros-args')
        with (
            Command((*CODETR, 'score', namespace, '--name', 'ben')) as page,
            Command((*program, '-r', f'__ns:={namespace}')) as scorer,
        ):
            scorer.until('scores what')
            page.until("nothing that 'ben' states is taken")
            url = page.until(r'score as ben at (http\S+)')[1]
            problem = shown_problem(url)
            assert 'has a key and this process has none' in problem
            assert 'CODETR_RUN_KEY' in problem
            with pytest.raises(urllib.error.HTTPError, match='422') as refused:
                judge(url, ['sim', 0, 0, 25], 3)
            assert 'CODETR_RUN_KEY' in refused.value.read().decode()
            scorer.until('published as number 0')
            requests = calls()
            assert requests, 'no call of the service is documented'
            for fields in requests:
                answer = called(namespace, ScoreSegment.Request(**(fields | {'token': token})))
                assert answer.accepted or 'segment' in answer.message, answer.message
                assert not called(namespace, ScoreSegment.Request(**fields)).accepted
            held.let_go()  # before, the run could end meanwhile
            scored, left = scorer.end(), page.end()
        code = train.end()
    assert code == 0, train.text
    assert scored == 0, scorer.text
    assert left == 1, page.text
    took = re.search(r'it took (\d+) judgements', scorer.text)
    records = [entry.record for entry in Bag(out / 'bag').entries()]
    scores = [r for r in records if isinstance(r, CompositeReward)]
    assert {'vision'} <= {r.scorer for r in scores} <= {'vision', 'ann'}
    numbers = [r.sequence for r in scores if r.scorer == 'vision']
    assert numbers == list(range(len(numbers)))
    assert 8 <= int(took[1]) <= len(numbers)
    summary = summary_of(out)
    assert summary['lost'] == 0
    assert summary['scorers']['vision']['scores'] == int(took[1])
    assert verify(out / 'bag').sound
