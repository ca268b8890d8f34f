"""Control steps are due every period, whatever happened before, and lateness is counted."""

import numpy as np
import pytest

from codetr_ros.robots.deadlines import Deadlines, Lateness


def test_no_step_is_due_before_the_first_and_then_one_every_period():
    deadlines = Deadlines(0.02)
    assert not deadlines.reached(1e9)
    deadlines.start(10.0)
    taken = [t for t in np.arange(10.0, 10.1, 0.001) if deadlines.reached(float(t))]
    assert len(taken) == 5 and deadlines.missed == 0
    assert deadlines.due == pytest.approx(10.1)


def test_a_step_that_comes_late_moves_no_other_deadline():
    deadlines = Deadlines(0.02)
    deadlines.start(10.0)
    assert deadlines.reached(10.0) and deadlines.reached(10.035)
    assert deadlines.missed == 0 and deadlines.due == pytest.approx(10.04)


def test_deadlines_without_a_command_are_missed_and_not_made_up_for():
    deadlines = Deadlines(0.02)
    deadlines.start(10.0)
    assert deadlines.reached(10.0)
    assert deadlines.reached(10.085)  # of those at .02, .04, .06 and .08, one
    assert (deadlines.missed, deadlines.steps) == (3, 2)
    assert not deadlines.reached(10.09)
    assert deadlines.reached(10.1)


def test_percentiles_are_those_of_all_delays_within_a_box():
    rng, lateness = np.random.default_rng(0), Lateness()
    delays = 1e-4 * np.exp(rng.normal(size=20_000))
    for delay in delays.tolist():
        lateness.add(delay)
    for share in (0.5, 0.99, 0.999):
        assert lateness.percentile(share) == pytest.approx(np.quantile(delays, share), rel=0.03)
    assert lateness.percentile(1.0) == lateness.largest == delays.max()
    assert int(lateness.counts.sum()) == 20_000


def test_without_delays_there_is_no_percentile():
    assert Lateness().percentile(0.5) == 0.0
