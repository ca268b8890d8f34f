"""Environments that are at fault: the error names the task, the call and what to do."""

import logging
import re
import sys

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces

from codetr_ros.simulation.environments import TaskError
from codetr_ros.simulation.tasks import make
from helpers.own_environments import OfParts, Point, TimesTen, registered


def stepping(answer):
    """An environment whose third step gives this: of (observation, reward, terminated, ...)."""

    class Odd(Point):
        def step(self, action):
            given = super().step(action)
            return answer(*given) if self.t == 3 else given

    return Odd


def resetting(reset):
    return type('Odd', (Point,), {'reset': reset})


def raising(error):
    def raise_it(*_, **__):
        raise error

    return raise_it


def run(entry_point):
    """Ten steps in an environment."""
    with registered(entry_point) as name:
        environment = make(name)
        environment.reset(3)
        for _ in range(10):
            environment.step(np.zeros(1, np.float32))


def of_two_sizes(o, r, te, tr, i):
    return np.append(o, 1), r, te, tr, i


@pytest.mark.parametrize(
    ('answer', 'message'),
    [
        (lambda o, r, te, tr, i: (o, r, te, i), r'4 values: return \(observation, reward, termi'),
        (lambda o, r, te, tr, i: o, r'ndarray of shape \(2,\): return \(observation, reward'),
        (lambda o, r, te, tr, i: None, r'returned None: return \(observation, reward'),
        (lambda o, r, te, tr, i: (o, [r], te, tr, i), r'reward is list \[.*: return one number'),
        (
            lambda o, r, te, tr, i: (o, np.array([r]), te, tr, i),
            r'reward is ndarray of shape \(1,\)',
        ),
        (lambda o, r, te, tr, i: (o, None, te, tr, i), 'reward is None: return one number'),
        (lambda o, r, te, tr, i: (o, '1.0', te, tr, i), "reward is str '1.0': return one number"),
        (lambda o, r, te, tr, i: (o, 1j, te, tr, i), r'reward is complex 1j: return one number'),
        (of_two_sizes, '3 observations, 2 announced'),
        (lambda o, r, te, tr, i: (o[:1], r, te, tr, i), '1 observations, 2 announced'),
        (lambda o, r, te, tr, i: (None, r, te, tr, i), '1 observations, 2 announced'),
        (lambda o, r, te, tr, i: ({'x': o}, r, te, tr, i), 'observation is dict .*no array'),
        (lambda o, r, te, tr, i: ([[1], [1, 2]], r, te, tr, i), 'observation is list .*no array'),
        (lambda o, r, te, tr, i: (o, r, None, tr, i), 'terminated is None: return a bool'),
        (lambda o, r, te, tr, i: (o, r, te, i, {}), 'truncated is dict {}: return a bool'),
        (lambda o, r, te, tr, i: (o, r, 'no', tr, i), "terminated is str 'no': return a bool"),
        (lambda o, r, te, tr, i: (o, float('nan'), te, tr, i), 'reward is nan, it must be finite'),
        (lambda o, r, te, tr, i: (o, -1e39, te, tr, i), r'reward is -1e\+39, .* as float32'),
        (
            lambda o, r, te, tr, i: (o * np.inf, r, te, tr, i),
            r'observation\[0\] is -?inf, it must',
        ),
    ],
)
def test_an_answer_of_step_that_is_none_is_refused_by_task_call_and_remedy(answer, message):
    with pytest.raises(TaskError, match=f"task 'Own-v0', step 3 of the episode: .*{message}"):
        run(stepping(answer))


@pytest.mark.parametrize(
    ('answer', 'reward'),
    [
        (lambda o, r, te, tr, i: (list(o), 2, 0, 0, i), 2.0),
        (lambda o, r, te, tr, i: (o, np.float32(2), np.bool_(te), np.False_, i), 2.0),
        (lambda o, r, te, tr, i: (o, np.array(2), np.array(te), np.int64(tr), None), 2.0),
        (lambda o, r, te, tr, i: (torch.tensor(o), torch.tensor(2.0), te, tr, i), 2.0),
        (lambda o, r, te, tr, i: (o.astype(float), True, te, tr, i), 1.0),
    ],
)
def test_an_answer_of_other_types_that_means_the_same_is_taken(answer, reward):
    with registered(stepping(answer)) as name:
        environment = make(name)
        environment.reset(3)
        steps = [environment.step(np.zeros(1, np.float32)) for _ in range(3)]
    observation, given, terminated = steps[-1]
    assert (given, type(given), terminated, environment.truncated) == (reward, float, False, False)
    assert observation.dtype == np.float32
    assert observation[1] == 3


@pytest.mark.parametrize(
    ('reset', 'message'),
    [
        (
            lambda self: self.observe(),
            r'raised TypeError.*unexpected keyword.*`seed` and `options`',
        ),
        (lambda self, *, seed=None, options=None: np.zeros(2), r'ndarray of shape \(2,\): return'),
        (lambda self, *, seed=None, options=None: (np.zeros(2), {}, 0), '3 values: return'),
        (
            lambda self, *, seed=None, options=None: (np.zeros(3), {}),
            '3 observations, 2 announced',
        ),
        (lambda self, *, seed=None, options=None: ('a', {}), "observation is str 'a', no array"),
        (raising(OSError('no arm')), 'raised OSError: no arm .test_faulty_environments.py, line'),
    ],
)
def test_a_reset_that_fails_is_refused_by_task_call_and_remedy(reset, message):
    with pytest.raises(TaskError, match=f"task 'Own-v0', reset: .*{message}"):
        run(resetting(reset))


@pytest.mark.parametrize('error', [RuntimeError('the arm is lost'), SystemExit(3), KeyError('q')])
def test_an_error_in_a_step_is_named_with_its_place_and_keeps_its_traceback(error):
    of_type = type('Breaks', (Point,), {'drift': raising(error)})
    message = (
        rf"task 'Own-v0', step 1 of the episode: the environment raised {type(error).__name__}: "
        r'.* \(test_faulty_environments.py, line \d+, in raise_it\). Mend it'
    )
    with pytest.raises(TaskError, match=message) as caught:
        run(of_type)
    assert caught.value.__cause__ is error


def test_an_error_inside_a_library_is_placed_where_the_environment_called_it():
    def drift(self):
        return np.linalg.inv(np.zeros((2, 2)))

    message = r'raised LinAlgError: Singular matrix \(test_faulty_environments.py, .* in drift\)'
    with pytest.raises(TaskError, match=message):
        run(type('Breaks', (Point,), {'drift': drift}))


def test_an_interrupt_while_an_environment_works_is_none_of_its_errors():
    with pytest.raises(KeyboardInterrupt):
        run(type('Stopped', (Point,), {'drift': raising(KeyboardInterrupt())}))


def needs_an_argument(robot):
    return Point()


@pytest.mark.parametrize(
    ('entry_point', 'message'),
    [
        (raising(FileNotFoundError('model.xml')), 'raised FileNotFoundError: model.xml .test_fau'),
        (needs_an_argument, r"raised TypeError: .*'robot'.*kwargs \({}\)\. .* with the `kwargs`"),
        (raising(SystemExit('no licence')), 'raised SystemExit: no licence'),
        (lambda: None, 'raised TypeError: The environment must inherit from the gymnasium.Env'),
        (lambda: TimesTen(gymnasium.Env()), '`observation_space` and `action_space`'),
        (raising(ImportError('no driver')), 'cannot be made: no driver. Install what it needs'),
    ],
)
def test_an_environment_that_cannot_be_made_is_refused_with_the_reason(entry_point, message):
    with pytest.raises(TaskError, match=f"task 'Own-v0'.*{message}"):
        run(entry_point)


@pytest.mark.parametrize(
    ('space', 'message'),
    [
        (
            {'observation_space': OfParts.observation_space},
            'wrappers.FlattenObservation around it',
        ),
        ({'action_space': spaces.Discrete(3)}, r'action space is Discrete\(3\).*ActionWrapper'),
        ({'action_space': spaces.Box(0, 9, (1,), np.int64)}, 'of real numbers for actions'),
        ({'action_space': spaces.Box(-1, 1, (0,))}, 'its action space has no numbers in it'),
        ({'observation_space': spaces.Box(-1, 1, (0,))}, 'its observation space has no numbers'),
    ],
)
def test_spaces_that_cannot_be_used_are_refused_with_what_to_wrap(space, message):
    with pytest.raises(TaskError, match=f"task 'Own-v0': .*{message}"):
        run(type('Odd', (Point,), space))


def test_an_error_in_close_is_logged_and_ends_nothing(caplog):
    with (
        registered(type('Stuck', (Point,), {'close': raising(OSError('busy'))})) as name,
        caplog.at_level(logging.WARNING, 'codetr_ros'),
    ):
        make(name).close()
    assert re.search("task 'Own-v0', close: the environment raised OSError: busy", caplog.text)


@pytest.mark.parametrize('horizon', [-1, 0, 2.5, '50'])
def test_a_horizon_that_is_no_number_of_steps_is_refused(horizon):
    with (
        registered(Point, horizon) as name,
        pytest.raises(TaskError, match=f'max_episode_steps is {horizon}: register'),
    ):
        make(name)


def test_a_module_whose_code_raises_is_refused_by_its_name(tmp_path, monkeypatch):
    (tmp_path / 'broken_tasks.py').write_text('1 / 0\n')
    monkeypatch.setattr(sys, 'path', [*sys.path, str(tmp_path)])
    message = (
        r"task 'broken_tasks:X-v0': module 'broken_tasks' cannot be imported: ZeroDivisionError: "
        r'.* \(broken_tasks.py, line 1, in <module>\). Install it'
    )
    with pytest.raises(TaskError, match=message):
        make('broken_tasks:X-v0')


def test_a_module_that_is_not_there_is_refused_without_a_place_in_the_library():
    with pytest.raises(
        TaskError, match=r"No module named 'no_such_robot'\. Install it, start from"
    ):
        make('no_such_robot:X-v0')
