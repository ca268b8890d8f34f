"""A checkpoint that is damaged behind right hashes is refused by name wherever one is loaded."""

import hashlib
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
import torch

from codetr_ros import cli
from codetr_ros.config import SettingsError
from codetr_ros.cores import in_process
from codetr_ros.cores.labeller import Labeller
from codetr_ros.rewards import saved
from codetr_ros.rewards.base import RewardModelError
from codetr_ros.runs import checkpoints
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs.checkpoints import CheckpointError
from helpers.builders import run, score, task_spec, tiny, transitions
from helpers.foreign_bags import write
from helpers.saved import trained


def rewrite(
    path: Path,
    body: Callable[[dict[str, Any]], Any] = lambda body: None,
    tensors: Callable[[dict[str, torch.Tensor]], Any] = lambda tensors: None,
    data: bytes | None = None,
) -> None:
    """Change a checkpoint, and make its hashes right again."""
    content = safetensors.torch.load((path / checkpoints.TENSORS).read_bytes())
    tensors(content)
    data = safetensors.torch.save(content) if data is None else data
    (path / checkpoints.TENSORS).write_bytes(data)
    described = json.loads((path / checkpoints.DESCRIPTION).read_text())
    del described['sha256']
    described['tensors_sha256'] = hashlib.sha256(data).hexdigest()
    described['digest'] = checkpoints.digest(content)
    body(described)
    canonical = json.dumps(described, sort_keys=True, separators=(',', ':')).encode()
    described['sha256'] = hashlib.sha256(canonical).hexdigest()
    (path / checkpoints.DESCRIPTION).write_text(json.dumps(described))


def meta(**changes: Any) -> Callable[[dict[str, Any]], None]:
    return lambda body: body['meta'].update(changes)


DAMAGE: dict[str, tuple[dict[str, Any], str]] = {
    'no tensors': ({'data': b'\x08' + b'\0' * 7 + b'nonsense'}, 'it holds no tensors'),
    'half a header': ({'data': b'\xff' * 8}, 'it holds no tensors'),
    'other tensors': (
        {'body': lambda body: body.update(digest='0' * 64)},
        f'the digest of its tensors is .* should be {"0" * 64}',
    ),
    'no hash of tensors': (
        {'body': lambda body: body.pop('tensors_sha256')},
        'tensors_sha256 = None must be of type str',
    ),
    'no meta': ({'body': lambda body: body.pop('meta')}, 'meta = None must be of type dict'),
    'a list for meta': ({'body': lambda body: body.update(meta=[1])}, r'meta = \[1\] must be of'),
    'a text for a size': ({'body': meta(observation_size='three')}, "size = 'three' must be a"),
    'a huge size': ({'body': meta(action_size=10**15)}, 'action_size = 10+ must be a whole'),
    'no size': ({'body': lambda body: body['meta'].pop('action_size')}, 'action_size = None must'),
    'a negative size': ({'body': meta(observation_size=-3)}, 'observation_size = -3 must be a'),
    'a list for settings': ({'body': meta(settings=[])}, r'settings = \[\] must be a text'),
    'brackets for settings': ({'body': meta(settings='[' * 9999)}, 'is nested too deeply'),
    'no settings': ({'body': meta(settings='{"delay": -1}')}, 'delay = -1'),
    'a number for the task': ({'body': meta(task=5)}, 'task = 5 must be a text'),
    'a text for the horizon': ({'body': meta(horizon='x')}, "horizon = 'x' must be a whole"),
}
TENSORS: dict[str, tuple[dict[str, Any], str]] = {
    'a tensor too few': ({'tensors': lambda t: t.pop('target_scale')}, 'target_scale is missing'),
    'a tensor too many': ({'tensors': lambda t: t.update(x=torch.ones(1))}, 'x is unknown'),
    'another shape': (
        {'tensors': lambda t: t.update(observation_mean=torch.zeros(9))},
        r'observation_mean is \(9,\) torch.float32, expected \(3,\)',
    ),
    'another type': (
        {'tensors': lambda t: t.update(version=torch.tensor(1.0))},
        'version is .* torch.float32, expected .* torch.int64',
    ),
    'a number that is none': (
        {'tensors': lambda t: t['observation_std'].fill_(float('nan'))},
        'observation_std has values that are not finite',
    ),
    'a negative scale': ({'tensors': lambda t: t['target_scale'].neg_()}, 'must not be negative'),
}


@pytest.mark.parametrize(('changes', 'expected'), DAMAGE.values(), ids=DAMAGE.keys())
def test_a_damaged_reward_model_is_refused_by_name(tmp_path, capsys, changes, expected):
    trained(tmp_path)
    path = checkpoints.latest(tmp_path, 'reward')
    rewrite(path)
    saved.read(path)  # what is rewritten without a change is sound

    rewrite(path, **changes)

    with pytest.raises((CheckpointError, SettingsError), match=expected) as refused:
        saved.read(path)
    assert str(path) in str(refused.value)
    assert len(str(refused.value)) < 1000
    with pytest.raises((CheckpointError, SettingsError), match=expected):
        Labeller(run(tiny()), tiny(), 'reward', None, str(path))
    bag = write(tmp_path / 'bag', [transitions(steps=7), score()])
    for command in (['label', str(bag), '--checkpoint'], ['fit', str(bag), '--checkpoint']):
        assert cli.main([*command, str(path), '--out', str(tmp_path / 'out')]) == 2
        assert str(path) in capsys.readouterr().err
        assert not (tmp_path / 'out').exists()


@pytest.mark.parametrize(('changes', 'expected'), TENSORS.values(), ids=TENSORS.keys())
def test_a_reward_model_of_damaged_tensors_is_refused_by_name(tmp_path, changes, expected):
    trained(tmp_path)
    path = checkpoints.latest(tmp_path, 'reward')
    rewrite(path, **changes)
    model = saved.read(path)
    with pytest.raises(RewardModelError, match=expected) as refused:
        saved.restore(model, model.settings, *model.sizes)
    assert str(path) in str(refused.value)
    core = Labeller(run(tiny()), tiny(), 'reward', None, str(path))
    core.receive(task_spec())
    work = core.work()
    with pytest.raises(RewardModelError, match=expected):
        next(work)


@pytest.mark.slow
def test_a_damaged_policy_is_refused_by_name(tmp_path, capsys):
    settings = tiny(steps=600)
    in_process.run(settings, 'run', tmp_path)
    run_folder.write_settings(tmp_path, settings)
    path = checkpoints.latest(tmp_path / run_folder.CHECKPOINTS, 'learner')
    assert cli.main(['evaluate', str(tmp_path)]) == 0
    whole = {file: file.read_bytes() for file in path.iterdir()}
    faults = {k: v for k, v in DAMAGE.items() if 'settings' not in k and 'task' not in k}
    faults.pop('a text for the horizon', None)
    faults |= {
        'more than there is': ({'body': meta(observation_size=999_999)}, 'more than its tensors'),
        'of another task': ({'body': meta(observation_size=5)}, 'expected'),
        'not finite': (
            {'tensors': lambda t: t['actor.heads.weight'].fill_(float('inf'))},
            'not finite',
        ),
    }
    for kind, (changes, expected) in faults.items():
        for file, content in whole.items():
            file.write_bytes(content)
        rewrite(path, **changes)
        capsys.readouterr()
        assert cli.main(['evaluate', str(tmp_path)]) == 2, kind
        said = capsys.readouterr().err
        assert str(path) in said and len(said) < 2000, kind
        assert re.search(expected, said), kind
