from codetr_ros.runs.spent import ProcessorTime
from codetr_ros.runs.summary import Summary
from helpers.summaries import SETTINGS, Clock, a_run, commit, episode


def test_the_time_of_an_evaluation_is_that_of_its_last_episode() -> None:
    clock = Clock()
    time = ProcessorTime(clock)
    for step, number, passed in ((0, 0, 1.0), (1000, 0, 2.0), (1000, 1, 0.5), (2000, 0, 4.0)):
        clock.now += passed
        purpose = 'evaluation' if step else 'random'
        time.receive(episode(purpose=purpose, step=step, episode=number))
    clock.now += 8.0
    time.receive(episode(purpose='training', source='sim', step=2500))
    time.receive(commit(2))

    assert [(row.step, row.cpu_s) for row in time.rows()] == [(1000, 3.5), (2000, 7.5)]


def test_a_run_that_goes_on_in_another_process_has_no_such_time() -> None:
    time = ProcessorTime(Clock())
    time.receive(episode(step=1000))
    time.go_on()
    time.receive(episode(step=2000))

    assert time.rows() == []


def test_a_summary_has_it_of_a_run_in_one_process_alone() -> None:
    for in_process in (True, False):
        made = Summary(SETTINGS, 'r', in_process)
        for record in a_run():
            made.receive(record)
        spent = made.build({}).spent

        assert [row.step for row in spent] == ([1000, 2000, 2500] if in_process else [])
        assert sorted(row.cpu_s for row in spent) == [row.cpu_s for row in spent]
