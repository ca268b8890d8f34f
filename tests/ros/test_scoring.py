"""The services with which anything scores, called over ROS, and who is refused."""

import math
import signal

import numpy as np
import pytest
from codetr_msgs.srv import ScoreSegment, WantedSegments

from codetr_ros.cli import score
from codetr_ros.nodes.signing import VARIABLE, new_key, token
from codetr_ros.pages.scoring import Points
from codetr_ros.records.roles import published_by
from helpers.builders import commit, run, score_request, task_spec, tiny, transitions
from helpers.playing import NAMESPACE, output, process

SETTINGS = tiny(scorer='topic', scorers=('vision',))
EVERYBODY = ('learner', 'sim', 'reward', 'record', 'evaluate')


class Caller:
    """Calls the services from another node."""

    def __init__(self, play, node):
        self._play, self._node = play, node
        self._clients = {}

    def __call__(self, kind, name, **request):
        if name not in self._clients:
            made = self._play.links['learner'].node.create_client(kind, name)
            self._clients[name] = made
            self._play.until(made.service_is_ready, self._node)
        future = self._clients[name].call_async(kind.Request(**request))
        self._play.until(future.done, self._node)
        return future.result()

    def wanted(self, **request):
        return self(WantedSegments, 'wanted_segments', **request)

    def score(self, **request):
        return self(ScoreSegment, 'score_segment', **request)


def everybody_there(play):
    """Whether the node reads what the test publishes, and the test what the node does."""
    names = {f'{NAMESPACE}/score'}
    topics = {'sim': ['transitions'], 'reward': ['score_requests'], 'record': ['commits']}
    return not any(
        play.links[role].unmatched(wanted, lambda _: names, readers=True)
        for role, wanted in topics.items()
    ) and not play.links['record'].unmatched(published_by('score'), lambda _: names, readers=False)


def test_what_is_scored_by_service_is_published_and_what_is_not_is_answered_why(play):
    play = play(settings=SETTINGS, roles=EVERYBODY)
    with process('score') as node:
        call = Caller(play, node)
        play.until(lambda: everybody_there(play), node)
        play.links['sim'].publish(task_spec())
        came = transitions(steps=70)
        play.links['sim'].publish(came)
        play.links['reward'].publish(score_request(firsts=[35, 14], length=7))
        wanted = play.until(
            lambda: (it := call.wanted(scorer='vision', steps=True)).sources and it, node
        )
        assert list(wanted.first_steps) == [35, 14] and list(wanted.lengths) == [7, 7]
        seen = np.array(wanted.observations, np.float32).reshape(-1, wanted.observation_size)
        assert np.array_equal(seen, came.observations[np.r_[35:42, 14:21]])
        given = {'scorer': 'vision', 'source': 'sim', 'episode': 0}
        answer = call.score(**given, first_step=35, value=7.5, lowest=0.0, highest=10.0)
        assert (answer.accepted, answer.sequence, answer.phase) == (True, 0, 0), answer.message
        answer = call.score(**given, first_step=14, cannot_tell=True, reason='too dark')
        assert (answer.accepted, answer.sequence) == (True, 1)
        for request, reason in (
            ({'scorer': 'eve'}, "'eve' is no scorer of this run"),
            ({'value': 11.0, 'highest': 10.0}, 'value 11 is not on the scale 0 to 10'),
            ({'value': math.nan}, 'value is NaN: give a number, or set cannot_tell'),
            ({'first_step': 36}, 'no segment begins at step 36'),
            ({'reason': 'x' * 256}, 'reason has 256 characters: give 255 at most'),
        ):
            answer = call.score(**(given | {'first_step': 35} | request))
            assert not answer.accepted and reason in answer.message
        assert not call.wanted(scorer='eve').accepted
        play.until(lambda: len(play.messages('CompositeReward', 'record')) == 2, node)
        play.links['record'].publish(commit(scorers=('vision',), scores=np.array([1], np.int64)))
        state = play.until(lambda: (it := call.wanted(scorer='vision')).phase == 0 and it, node)
        assert (state.given, state.taken, state.finished) == (2, 1, False)
        node.send_signal(signal.SIGTERM)
        play.until(lambda: node.poll() is not None)
        said = output(node)
    first, second = play.messages('CompositeReward', 'record')
    assert (first.scorer, first.sequence, first.first_step, first.value) == ('vision', 0, 35, 7.5)
    assert (second.sequence, second.first_step) == (1, 14) and math.isnan(second.value)
    assert 'reason: too dark' in said and 'refused a call of score_segment by' in said


def test_in_a_run_with_a_key_callers_need_the_token_and_what_goes_out_is_signed(play, monkeypatch):
    monkeypatch.setenv(VARIABLE, new_key())
    play = play(settings=SETTINGS, roles=EVERYBODY)
    with process('score') as node:
        call = Caller(play, node)
        play.until(lambda: everybody_there(play), node)
        refused = call.wanted(scorer='vision')
        assert 'token is empty: this run has a key' in refused.message
        own = token(play.links['learner'].key, NAMESPACE)
        assert call.wanted(scorer='vision', token=own).accepted
        assert not call.wanted(scorer='vision', token=own[:-1]).accepted
        node.send_signal(signal.SIGTERM)
        play.until(lambda: node.poll() is not None)
        assert f'scores by service: {NAMESPACE}/score_segment, token {own}' in output(node)


def test_a_node_without_the_key_leaves_a_run_that_has_one_and_names_the_remedy(play, monkeypatch):
    monkeypatch.setenv(VARIABLE, new_key())
    play = play(settings=SETTINGS, roles=EVERYBODY)
    monkeypatch.delenv(VARIABLE)
    with process('score') as node:
        play.until(lambda: node.poll() is not None)
        said = output(node)
    assert node.returncode == 1
    assert "run 'run' has a key and this process has none" in said
    assert f'Set {VARIABLE} before you start the run' in said


def test_a_node_with_another_key_names_the_key_and_not_the_learner_as_what_is_lacking(
    play, monkeypatch
):
    monkeypatch.setenv(VARIABLE, new_key())
    play = play(settings=SETTINGS, roles=EVERYBODY)
    monkeypatch.setenv(VARIABLE, new_key())
    with process('score', 'peer_deadline:=3.0') as node:
        play.until(lambda: node.poll() is not None)
        said = output(node)
    assert node.returncode == 1
    assert f'signed with the key of this node: give it the {VARIABLE} of the run' in said


@pytest.mark.parametrize(
    ('settings', 'reason'),
    [
        ({'scorer': 'topic', 'scorers': ('ben',)}, "'ann' is no scorer of this run"),
        ({'scorer': 'simulator'}, "come from scorer = 'simulator'"),
    ],
    ids=['another name', 'the simulator scores'],
)
def test_the_page_of_a_scorer_whom_the_run_does_not_name_takes_nothing(settings, reason, capsys):
    given = score.Arguments('/r', name='ann')
    page = score.Page(given, Points.of('1:5'))
    settings = tiny(**settings)
    desk = page.load()(run(settings), settings, 'score_ann', None)
    try:
        assert reason in desk.document()['problem']
        assert f"codetr: nothing that 'ann' states is taken: {page.problem}" in (
            capsys.readouterr().err
        )
    finally:
        desk.close()
