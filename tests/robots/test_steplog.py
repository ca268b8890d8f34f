"""Steps go out in order, without gaps, cut at phases and episodes, whatever ends them."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from codetr_ros.records import Transitions
from codetr_ros.robots.steplog import StepLog


def obs(number: int) -> np.ndarray:
    return np.array([number], np.float32)


def logged(lengths: list[int], phase_steps: int, every: float) -> list[Transitions]:
    log = StepLog('run', 'arm', lambda phase: phase_steps)
    records: list[Transitions] = []
    number = 0
    for length in lengths:
        log.begin()
        for _ in range(length):
            records += log.add(obs(number), obs(number), obs(number + 1), number * every)
            number += 1
        records += log.end()
        number += 1
    return records


@given(st.lists(st.integers(0, 12), max_size=8), st.integers(1, 9), st.sampled_from([0.01, 0.5]))
def test_no_step_is_lost_or_doubled_and_each_phase_ends_where_it_should(lengths, steps, every):
    records = logged(lengths, steps, every)
    actions = np.concatenate([r.actions[:, 0] for r in records]) if records else np.empty(0)
    starts = np.cumsum([0, *(n + 1 for n in lengths)])
    wanted = [b + i for b, n in zip(starts, lengths, strict=False) for i in range(n)]
    assert actions.tolist() == wanted
    assert [r.sequence for r in records] == list(range(len(records)))
    for r in records:
        assert r.observations[:-1, 0].tolist() == r.actions[:, 0].tolist()
        assert r.observations[-1, 0] == r.actions[-1, 0] + 1
    ends = np.cumsum([r.steps for r in records])
    assert [bool(r.phase_end) for r in records] == (ends % steps == 0).tolist()
    assert all(r.phase == (end - 1) // steps for r, end in zip(records, ends, strict=True))
    ended = [r for r in records if r.truncated]
    assert [r.first_step + r.steps for r in ended] == [n for n in lengths if n]
    assert [r.episode for r in ended] == list(range(len(ended)))


def test_whole_steps_go_out_every_second_but_the_newest_waits():
    log = StepLog('run', 'arm', lambda phase: 1000)
    log.begin()
    sizes = [sum(r.steps for r in log.add(obs(i), obs(i), obs(i + 1), i * 0.1)) for i in range(21)]
    assert [(i, n) for i, n in enumerate(sizes) if n] == [(10, 10), (20, 10)]
