"""What a node logs of its course: neither silence nor a flood."""

from codetr_ros.records import metrics
from codetr_ros.ros.course import Course
from helpers.builders import tiny
from helpers.summaries import Clock, episode


class Log(list):
    """A logger that keeps its lines."""

    info = list.append


def a_course(counts=True, **changes):
    clock, log = Clock(), Log()
    settings = tiny(steps=1200, phase_steps=200, evaluate_every=200, **changes)
    return Course(settings, log, clock, counts), clock, log


def ended(phase):
    return metrics('r', 'reward', '/r/reward', phase, 200 * (phase + 1), {'reward_loss': 0.25})


def test_a_phase_that_is_done_is_a_line_with_its_numbers():
    course, clock, log = a_course()
    for phase in range(2):
        clock.now += 3
        course.note(ended(phase))
    assert log == [
        'phase 1 of 6 is done, 200 of 1200 steps: reward_loss 0.25',
        'phase 2 of 6 is done, 400 of 1200 steps: reward_loss 0.25',
    ]


def test_the_first_phase_is_a_line_however_soon_it_is_done():
    course, _, log = a_course()
    course.tick('works')
    course.note(ended(0))
    assert len(log) == 1


def test_many_short_phases_are_no_flood():
    course, clock, log = a_course()
    for phase in range(6):
        clock.now += 0.4
        course.note(ended(phase))
    assert [line.split()[1] for line in log] == ['1', '4', '6'], 'the last one always'


def test_a_node_that_waits_or_computes_for_long_logs_every_ten_seconds():
    course, clock, log = a_course()
    for _ in range(26):
        clock.now += 1
        course.tick('waits for the policy of phase 0')
    assert log == ['waits for the policy of phase 0; no phase of 6 is done'] * 2
    course.note(ended(0))
    clock.now += 10
    course.tick('works')
    assert log[-1] == 'works; phase 1 of 6 is done, 200 of 1200 steps'


def test_an_evaluation_is_a_line_once_all_its_episodes_are_there():
    course, clock, log = a_course(evaluate_episodes=2)
    for number, true in enumerate((10.0, 30.0)):
        clock.now += 2
        course.note(episode(step=400, episode=number, true_return=true))
    course.note(episode(purpose='random', step=0))
    assert log == ['evaluated after 400 of 1200 steps: true return 20.0, 2 episodes']


def test_a_node_that_publishes_no_metrics_states_nothing_of_phases_that_it_does_not_count():
    course, clock, log = a_course(counts=False)
    for _ in range(11):
        clock.now += 1
        course.tick("waits for a judgement of 'ann'")
    assert log == ["waits for a judgement of 'ann'"]
