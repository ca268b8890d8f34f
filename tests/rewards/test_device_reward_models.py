"""Reward models on a device: what can be said without a GPU, and what a GPU must hold."""

import re

import numpy as np
import pytest
import torch

from codetr_ros.config import CodetrSettings
from codetr_ros.cores import in_process
from codetr_ros.memory import on_device
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import CompositeReward, Transitions
from codetr_ros.rewards import learned, registry, transformer
from codetr_ros.rewards.base import segment_steps
from codetr_ros.rewards.learned import Learned
from codetr_ros.runs import checkpoints
from codetr_ros.system.devices import DeviceError
from helpers.builders import tiny
from helpers.devices import needs_gpu

METHODS = [name for name, method in registry.METHODS.items() if issubclass(method, Learned)]
OBSERVATION, ACTION, DELAY, EPISODE = 5, 3, 4, 18


def memory() -> Trajectories:
    """Scored episodes, the last segment of each shorter than the others."""
    found = Trajectories(OBSERVATION, ACTION, DELAY, 1000, 50)
    rng = np.random.default_rng(0)
    for n in range(8):
        observations = rng.standard_normal((EPISODE + 1, OBSERVATION), np.float32)
        actions = rng.uniform(-1, 1, (EPISODE, ACTION)).astype(np.float32)
        found.append(
            Transitions(
                run_id='run',
                source='sim',
                sequence=n,
                phase=n,
                episode=n,
                first_step=0,
                steps=EPISODE,
                observations=observations,
                actions=actions,
                terminated=False,
                truncated=True,
                phase_end=True,
                scores_due=1,
            )
        )
        for first in range(0, EPISODE, DELAY):
            length = min(DELAY, EPISODE - first)
            value = float(observations[first : first + length, 0].sum())
            found.score(
                CompositeReward(
                    run_id='run',
                    source='sim',
                    scorer='sim',
                    sequence=0,
                    episode=n,
                    first_step=first,
                    length=length,
                    value=value,
                )
            )
    return found


def settings(method: str, device: str = 'cpu', **changes):
    return tiny(method=method, delay=DELAY, reward_device=device, **changes)


def fitted(method: str, device: str, steps: int = 5, **changes) -> Learned:
    model = registry.make(settings(method, device, **changes), OBSERVATION, ACTION)
    data = memory()
    model.prepare(data)
    for step in range(steps):
        torch.manual_seed(step)
        model.gradient_step(data, np.random.default_rng(step))
    return model


@pytest.mark.parametrize('dropout', [0.0, 0.1])
@pytest.mark.parametrize('tokens', ['pair', 'merged'])
@pytest.mark.parametrize('method', METHODS)
def test_nothing_is_left_on_the_cpu_that_the_network_meets(method, tokens, dropout, monkeypatch):
    """By tensors without values, which know where they are: torch refuses to mix devices."""
    monkeypatch.setattr(learned, 'usable', lambda device, field: torch.device('meta'))
    chosen = settings(method, 'cuda')
    chosen = chosen.changed({'codetr.tokens': tokens, 'codetr.dropout': dropout})
    data = memory()
    model = registry.make(chosen, OBSERVATION, ACTION)
    model.prepare(data)
    if method != 'rbt':  # it asks how many steps there are, which such tensors do not know
        for terms in model._terms(data, np.random.default_rng(0)):
            torch.stack(list(terms.values())).sum().backward()
    for parameter in model.network.parameters():
        tensors = parameter, *model._optimiser.state[parameter].values()
        assert {tensor.device.type for tensor in tensors} == {'meta'}
    model.network.eval()
    batch = data.segments.batch(data.segments.ids(), model.context)
    assert model._step_rewards(batch).device.type == 'meta'
    assert model.state()['observation_mean'].device.type == 'meta'


@pytest.mark.parametrize('device', ['cpu', pytest.param('cuda', marks=needs_gpu)])
@pytest.mark.parametrize('method', ['codetr', 'rbt'])
@pytest.mark.parametrize(
    'changes', [{}, {'reward_unit': 'raw', 'codetr.context': 'episode', 'codetr.window': 6}]
)
def test_labels_put_together_on_the_device_are_those_of_the_host(
    method, changes, device, monkeypatch
):
    """While the ring wraps, old episodes are evicted and a second source appears."""
    monkeypatch.setattr(on_device, 'COPIED_AT_ONCE', 7)
    chosen = settings(method, device).changed(changes)
    model = registry.make(chosen, OBSERVATION, ACTION)
    data = Trajectories(OBSERVATION, ACTION, DELAY, 60, 30)
    rng = np.random.default_rng(0)
    for n in range(12):
        for source in ('sim', 'another')[: 1 + n // 4]:
            observations = rng.standard_normal((EPISODE + 1, OBSERVATION), np.float32)
            actions = rng.uniform(-1, 1, (EPISODE, ACTION)).astype(np.float32)
            # a source's episodes number from 0 on
            number = n if source == 'sim' else n - 4
            data.append(
                Transitions(
                    run_id='run',
                    source=source,
                    sequence=number,
                    phase=n,
                    episode=number,
                    first_step=0,
                    steps=EPISODE,
                    observations=observations,
                    actions=actions,
                    terminated=False,
                    truncated=True,
                    phase_end=True,
                    scores_due=1,
                )
            )
            for first in range(0, EPISODE, DELAY):
                length = min(DELAY, EPISODE - first)
                data.score(
                    CompositeReward(
                        run_id='run',
                        source=source,
                        scorer=source,
                        sequence=0,
                        episode=number,
                        first_step=first,
                        length=length,
                        value=float(rng.normal()),
                    )
                )
        data.evict()
        model.prepare(data)
        ids = data.segments.ids()
        batch = data.segments.batch(ids, model.context)
        expected = model.label(batch)[segment_steps(batch)]
        found = model.label_on_device(data, ids)
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
    assert min(ring.start for ring in data.store.sources) > 60


@pytest.mark.skipif(torch.cuda.is_available(), reason='there is a GPU here')
def test_a_gpu_that_is_not_here_is_said_with_the_setting_that_wants_it():
    said = re.compile('^reward_device=cuda:1: torch .* or set reward_device=cpu$')
    with pytest.raises(DeviceError, match=said):
        in_process.run(tiny(method='codetr', reward_device='cuda:1'), 'run')


@needs_gpu
@pytest.mark.parametrize('method', METHODS)
def test_a_gpu_learns_and_labels_what_a_cpu_does(method):
    """Without dropout, whose masks come from the device's own generator."""
    changes = {'codetr.dropout': 0.0, 'mil_lstm.dropout': 0.0}
    ours, theirs = (fitted(method, device, **changes) for device in ('cuda', 'cpu'))
    data = memory()
    batch = data.segments.batch(data.segments.ids(), ours.context)
    np.testing.assert_allclose(ours.label(batch), theirs.label(batch), rtol=1e-3, atol=1e-3)


@needs_gpu
@pytest.mark.parametrize('method', METHODS)
def test_a_state_goes_from_one_device_to_another_and_the_same_seed_learns_the_same(method):
    ours, again = fitted(method, 'cuda'), fitted(method, 'cuda')
    data = memory()
    batch = data.segments.batch(data.segments.ids(), ours.context)
    np.testing.assert_allclose(ours.label(batch), again.label(batch), rtol=1e-3, atol=1e-3)
    there = registry.make(settings(method), OBSERVATION, ACTION)
    there.load_state({name: tensor.cpu() for name, tensor in ours.state().items()})
    assert checkpoints.digest(there.state()) == checkpoints.digest(ours.state())
    np.testing.assert_allclose(ours.label(batch), there.label(batch), rtol=1e-3, atol=1e-3)


@needs_gpu
@pytest.mark.parametrize('tokens', ['pair', 'merged'])
def test_no_plan_is_made_for_each_number_of_windows_that_a_gpu_labels(tokens):
    """cuDNN makes one for its attention; the memory has more segments in each phase."""
    chosen = CodetrSettings(layers=2, precision='bfloat16', tokens=tokens)
    network = transformer.CausalTransformer(OBSERVATION, ACTION, 25, chosen).cuda().eval()
    steps = (torch.randn(40, 25, size, device='cuda') for size in (OBSERVATION, ACTION))
    with torch.inference_mode(), torch.profiler.profile() as looked:
        network(*steps)
        torch.cuda.synchronize()
    kernels = [event.key for event in looked.key_averages() if event.self_device_time_total]
    assert kernels and not [name for name in kernels if 'cudnn' in name]
