"""Simulated people, each with a scale of its own, and a person who joins them, over topics."""

import numpy as np
import pytest

from codetr_ros.bags.reader import Bag
from codetr_ros.bags.verify import verify
from codetr_ros.cli import main
from codetr_ros.nodes.signing import VARIABLE, new_key
from codetr_ros.records import Commit, CompositeReward, ScoreRequest
from codetr_ros.runs import reports
from helpers import slow_robots
from helpers.judging import CODETR, PATIENCE, Command, first_waiting, judge, summary_of
from helpers.nodes import domain

FLAGS = (
    *('--scorer', 'simulated', '--people.count', '2', '--people.late', '100'),
    *('--people.shared', '0.5', '--people.best', '-3', '--requests', '8'),
    *('--task', slow_robots.REACHER, '--delay', '25', '--method', 'evidence'),
    *('--steps', '4000', '--warmup-steps', '1000', '--phase-steps', '500'),
    *('--evaluate-every', '0', '--no-film', '--sac.hidden', '32', '32'),
    *('--peer-deadline', str(PATIENCE)),
)
PEOPLE = ('person_a', 'person_b')


def corrected(url: str) -> tuple:
    """Score a segment on a page, and correct the score; the segment."""
    segment = first_waiting(url)
    judge(url, segment, 2)
    assert judge(url, segment, 5)['sequence'] == 1
    return tuple(segment)


@pytest.fixture(scope='module')
def a_run(tmp_path_factory):
    """A run whose key was handed over, and the segment that a person scored and corrected."""
    out = tmp_path_factory.mktemp('people') / 'run'
    key, held = {VARIABLE: new_key()}, slow_robots.Held(out.parent, 0.02)
    words = (*CODETR, 'train', *FLAGS, '--out', str(out))
    with domain(), Command(words, key | held.variables) as train:
        namespace = train.until(r'namespace: (\S+)')[1]
        with Command((*CODETR, 'score', namespace, '--name', 'ann'), key) as page:
            url = page.until(r'score as ann at (http\S+)')[1]
            segment = corrected(url)
            held.let_go()  # before, the run could end while the page opens
            assert page.end() == 0, page.text
        assert train.end() == 0, train.text
    return out, segment


@pytest.mark.slow
def test_every_judgement_of_people_is_in_the_bag_once_and_none_is_lost_or_refused(a_run):
    out, _ = a_run
    records = [entry.record for entry in Bag(out / 'bag').entries()]
    scores = [r for r in records if isinstance(r, CompositeReward)]
    for name in (*PEOPLE, 'ann'):
        numbers = [r.sequence for r in scores if r.scorer == name]
        assert numbers == list(range(len(numbers))) and numbers, name
    given = {r.name: r.counters for r in reports.read_all(out).values()}
    assert given['score']['scores'] == sum(r.scorer in PEOPLE for r in scores)
    assert sum(r.scorer == 'ann' for r in scores) == 2
    summary = summary_of(out)
    assert summary['lost'] == summary['refused'] == 0
    assert verify(out / 'bag').sound


@pytest.mark.slow
def test_people_answer_what_they_are_asked_on_scales_of_their_own(a_run):
    out, segment = a_run
    records = [entry.record for entry in Bag(out / 'bag').entries()]
    asked = {
        each
        for r in records
        if isinstance(r, ScoreRequest)
        for each in zip(r.sources, r.episodes.tolist(), r.first_steps.tolist(), strict=True)
    }
    scores = [r for r in records if isinstance(r, CompositeReward)]
    answered = {(r.source, r.episode, r.first_step) for r in scores if r.scorer in PEOPLE}
    assert answered <= asked and len(answered) > 10  # of eight phases with eight each
    by_name = {name: {r.value for r in scores if r.scorer == name} for name in PEOPLE}
    assert by_name['person_a'] <= {1.0, 2.0, 3.0, 4.0, 5.0}
    assert by_name['person_b'] <= {0.0, 1.0, 2.0, 3.0, 4.0, 5.0}
    assert 0.0 in by_name['person_b']
    commits = [r for r in records if isinstance(r, Commit)]
    named = dict(zip(commits[-1].scorers, commits[-1].scores.tolist(), strict=True))
    assert set(named) == {*PEOPLE, 'ann'}
    assert named['ann'] == 1
    of_ann = [r for r in scores if r.scorer == 'ann']
    assert [(r.source, r.episode, r.first_step, r.length) for r in of_ann] == 2 * [segment]
    assert [r.value for r in of_ann] == [2.0, 5.0]


@pytest.mark.slow
def test_a_correction_replaces_what_it_corrects_and_each_scale_is_learnt(a_run):
    scorers = summary_of(a_run[0])['scorers']
    assert scorers['ann']['scores'] == 1, 'two were given of one segment'
    for name in PEOPLE:
        assert scorers[name]['scores'] > 3
        assert np.isfinite([scorers[name][what] for what in ('offset', 'slope', 'noise')]).all()
    # the scale of who scored first, which the machine decides, is that of the rewards
    references = [s for s in scorers.values() if (s['offset'], s['slope']) == (0, 1)]
    assert len(references) == 1


@pytest.mark.slow
def test_the_weights_of_a_run_that_people_taught_are_derived_again_from_its_bag(a_run, capsys):
    assert main(['replay', str(a_run[0]), '--verify']) == 0, capsys.readouterr()
