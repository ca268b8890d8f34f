"""The file of a trained policy: what is in it, what it refuses, and how it tests itself."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy
from safetensors import safe_open

from codetr_ros.policy.acting import ActingPolicy
from codetr_ros.policy.network import PLAIN, STANDARDISED, Network, NetworkError
from codetr_ros.robots import policy_file
from codetr_ros.robots.policy_export import export
from codetr_ros.robots.policy_file import PolicyFileError, find, load
from codetr_ros.robots.same_robot import AnotherRobotError
from codetr_ros.runs import checkpoints
from helpers import policies
from helpers.builders import tiny
from helpers.robots import rules

SETTINGS = tiny(task='robot/arm', evaluate_every=0, delay=5)


@pytest.mark.parametrize('segment_steps', [0, 5])
@pytest.mark.parametrize('kind', [PLAIN, STANDARDISED])
def test_what_was_exported_acts_as_the_policy_that_was_learnt(tmp_path, kind, segment_steps):
    file = policies.policy_file(tmp_path, kind, segment_steps)
    learnt = policies.policy(Network(kind, 4, 2, (16, 8), segment_steps))
    acting = ActingPolicy.from_record(learnt, 4, 2, segment_steps)
    rng = np.random.default_rng(3)
    for step in range(20):
        seen = rng.standard_normal(4).astype(np.float32)
        np.testing.assert_allclose(
            file.policy.act(seen, step), acting.act(seen, step=step), rtol=0, atol=1e-6
        )
    assert file.test() <= 1e-6


def test_the_file_says_all_that_acting_takes(tmp_path):
    live = {'limits': {'change': 3.0}}
    units = ['rad', 'rad/s']
    seen = [rules().observation[0].model_dump() | {'units': units}]
    mapping = rules(live, observation=seen)
    file = policies.policy_file(tmp_path, robot=policies.facts(mapping))
    with safe_open(tmp_path / 'policy.safetensors', framework='numpy') as raw:
        said = json.loads(raw.metadata()['description'])
        assert set(raw.keys()) >= {'policy/heads.weight', 'test/observations', 'test/actions'}
    assert (said['format'], said['run_id'], said['phase']) == (1, 'run', 3)
    assert said['settings_hash'] == SETTINGS.hash()
    assert said['action'] == 'tanh(mean), without noise'
    robot = said['robot']
    assert robot['types'] == {'/joint_states': 'sensor_msgs/msg/JointState'}
    assert robot['sizes'] == [4]
    (entry,) = robot['mapping']['observation']
    assert (entry['topic'], entry['joints'], entry['units']) == (
        '/joint_states',
        ['a', 'b'],
        units,
    )
    assert robot['mapping']['action']['low'] == [-1.5, -2.0]
    assert robot['mapping']['live']['rate'] == 10.0
    assert robot['mapping']['live']['command']['safe'] == 0.0
    assert robot['mapping']['live']['limits']['change'] == 3.0
    assert file.described.robot.mapping == mapping


def test_its_digest_is_the_one_that_reports_and_checkpoints_have(tmp_path):
    file = policies.policy_file(tmp_path)
    weights = safetensors.torch.load(policies.policy(file.network).weights)
    assert file.described.policy_sha256 == checkpoints.digest(weights)


@pytest.mark.parametrize('place', [0.02, 0.3, 0.5, 0.9, 0.999])
def test_a_damaged_file_is_refused(tmp_path, place):
    policies.policy_file(tmp_path)
    path = tmp_path / 'policy.safetensors'
    data = bytearray(path.read_bytes())
    data[int(place * len(data))] ^= 4
    path.write_bytes(data)
    with pytest.raises(PolicyFileError, match='policy.safetensors.*damaged.*codetr export RUN'):
        load(path)


@pytest.mark.parametrize('keep', [0, 7, 100, 2000, -1])
def test_a_file_that_is_cut_short_is_refused(tmp_path, keep):
    policies.policy_file(tmp_path)
    path = tmp_path / 'policy.safetensors'
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(PolicyFileError, match='is no policy file, or is damaged'):
        load(path)


def rewritten(path: Path, **changes) -> None:
    """Write a file anew with another description, or other tensors, and sound digests."""
    file = load(path)
    held = safetensors.numpy.load(path.read_bytes())
    weights = {k.removeprefix('policy/'): v for k, v in held.items() if k.startswith('policy/')}
    examples = dict(file.examples)
    for name in [name for name in changes if name in examples]:
        examples[name] = changes.pop(name)(examples[name])
    said = file.described.model_dump(mode='json') | changes
    policy_file.write(path, said, weights, examples)


def test_a_file_that_does_not_act_as_it_did_fails_its_own_test(tmp_path):
    policies.policy_file(tmp_path)
    path = tmp_path / 'policy.safetensors'
    rewritten(path, actions=lambda actions: actions + np.float32(1e-3))
    with pytest.raises(PolicyFileError, match='fails its own test: for 16 of 16 observations'):
        load(path).test()
    rewritten(path, actions=lambda actions: actions * np.float32(np.nan))
    with pytest.raises(PolicyFileError, match='fails its own test'):
        load(path).test()


def test_a_file_of_a_later_format_is_refused_and_both_are_named(tmp_path):
    policies.policy_file(tmp_path)
    rewritten(tmp_path / 'policy.safetensors', format=2)
    with pytest.raises(PolicyFileError, match=r'has format = 2, but this version .* reads 1'):
        load(tmp_path / 'policy.safetensors')


@pytest.mark.parametrize(
    ('changes', 'said'),
    [
        ({'network': '{}'}, 'not one of this version'),
        ({'tolerance': 0}, 'tolerance = 0: Input should be greater than 0'),
        ({'robot': {}}, 'robot.mapping'),
        ({'actions': lambda actions: actions[:3]}, 'no examples to test itself by that fit'),
    ],
)
def test_a_description_that_does_not_fit_is_refused(tmp_path, changes, said):
    policies.policy_file(tmp_path)
    rewritten(tmp_path / 'policy.safetensors', **changes)
    with pytest.raises(PolicyFileError, match=said):
        load(tmp_path / 'policy.safetensors')


def test_a_checkpoint_of_a_run_is_no_policy_file(tmp_path):
    path = tmp_path / 'tensors.safetensors'
    safetensors.numpy.save_file({'a': np.zeros(3, np.float32)}, path)
    with pytest.raises(PolicyFileError, match='without the description of a policy'):
        load(path)
    with pytest.raises(PolicyFileError, match='cannot be read'):
        load(tmp_path / 'nothing')


def test_a_run_and_its_checkpoint_name_the_file_that_was_made_of_it(tmp_path):
    policies.policy_file(tmp_path)
    path = tmp_path / 'policy.safetensors'
    for phase in (2, 3):
        (tmp_path / 'checkpoints' / f'learner-{phase:06d}').mkdir(parents=True)
    newest = tmp_path / 'checkpoints' / 'learner-000003'
    for named in (path, tmp_path, tmp_path / 'checkpoints', newest):
        assert find(named) == path
    with pytest.raises(PolicyFileError, match='after phase 3, not that of .*learner-000002'):
        find(newest.with_name('learner-000002'))
    newest.with_name('learner-000004').mkdir()
    with pytest.raises(PolicyFileError, match='not that of .*learner-000004: make it anew with'):
        find(tmp_path)
    path.unlink()
    with pytest.raises(PolicyFileError, match='has no policy file, .*`codetr export'):
        find(tmp_path)


def test_a_policy_that_does_not_fit_the_robot_is_not_exported(tmp_path):
    made = policies.policy(Network(PLAIN, 4, 3, (8,)))
    with pytest.raises(PolicyFileError, match='actions of 3 numbers, and a command .* has 2'):
        export(made, policies.facts(), SETTINGS, tmp_path / 'p')
    made = policies.policy(Network(PLAIN, 5, 2, (8,)))
    with pytest.raises(AnotherRobotError, match='observations of 5 numbers, .* give 4'):
        export(made, policies.facts(), SETTINGS, tmp_path / 'p')
    still = policies.facts(rules().model_copy(update={'live': None}))
    with pytest.raises(PolicyFileError, match='no part `live`'):
        export(made, still, SETTINGS, tmp_path / 'p')
    random = replace(made, network='', random=True)
    with pytest.raises(NetworkError, match='not one of this version'):
        export(random, policies.facts(), SETTINGS, tmp_path / 'p')
    assert list(tmp_path.iterdir()) == []


def test_a_policy_that_amplifies_rounding_without_bound_is_not_exported(tmp_path):
    network = Network(PLAIN, 64, 2, (2,))  # the small difference of two huge numbers
    rng = np.random.default_rng(0)
    huge = 1e6 * rng.standard_normal(64)
    weights = {
        'body.0.weight': np.array([huge, huge + rng.standard_normal(64)]),
        'body.0.bias': np.full(2, 1e8),
        'heads.weight': np.array([[1, -1]] * 4),
        'heads.bias': np.zeros(4),
    }
    data = safetensors.numpy.save({k: v.astype(np.float32) for k, v in weights.items()})
    made = replace(policies.policy(network), weights=data)
    with pytest.raises(PolicyFileError, match='differ by .*: its weights amplify rounding'):
        export(made, policies.facts(sizes=()), SETTINGS, tmp_path / 'p')


def test_reading_a_policy_file_takes_no_torch(tmp_path):
    policies.policy_file(tmp_path)
    program = (
        "import sys\nfor name in ('torch', 'gymnasium', 'mujoco'): sys.modules[name] = None\n"
        'from pathlib import Path\n'
        'from codetr_ros.robots.policy_file import load\n'
        f'print(load(Path({str(tmp_path / "policy.safetensors")!r})).test())'
    )
    done = subprocess.run(
        [sys.executable, '-c', program], check=True, capture_output=True, text=True, timeout=180
    )
    assert float(done.stdout) <= 1e-6
