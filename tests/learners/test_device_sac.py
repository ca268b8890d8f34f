"""SAC with its steps on a device: what can be said without a GPU, and what a GPU must hold."""

import numpy as np
import pytest
import safetensors.torch
import torch

from codetr_ros.config import SacSettings
from codetr_ros.cores import in_process
from codetr_ros.learners import registry
from codetr_ros.learners.device_sac import WARM_UP_CALLS, DeviceSAC
from codetr_ros.learners.flat_sac import FlatSAC
from codetr_ros.learners.from_labels import FromLabelsOnDevice
from codetr_ros.policy.actor import weights_bytes
from codetr_ros.runs import checkpoints
from codetr_ros.system.devices import DeviceError, usable
from helpers.builders import tiny
from helpers.devices import ACTION, OBSERVATION, Run, needs_gpu
from helpers.tensors import same

torch.set_num_threads(1)  # a second thread is slower at these sizes

SIZES = (OBSERVATION, ACTION)
DEVICES = ['cpu', pytest.param('cuda', marks=needs_gpu)]


def settings(**changes) -> SacSettings:
    small = {'hidden': (24, 16), 'batch': 32, 'compile': False, 'tau': 0.05}
    return SacSettings(**small | changes)


def make(device: str = 'cpu', seed: int = 0, record=None) -> DeviceSAC:
    return DeviceSAC(*SIZES, settings(), seed, device, record)


def replay(sac: DeviceSAC, updates: int, seed: int = 0) -> dict[str, float]:
    torch.manual_seed(seed)
    return {name: float(total) for name, total in sac.replay(updates).items()}


def check_close(one: FlatSAC, other: FlatSAC, tolerance: float = 1e-4) -> None:
    mine, theirs = one.state(), other.state()
    for name, tensor in theirs.items():
        largest = max(1e-3, float(tensor.abs().max()))
        assert float((mine[name] - tensor).abs().max()) / largest < tolerance, name


class Eager:
    """Records as a GPU would, as far as one can tell from outside: it calls a few times first."""

    def __init__(self) -> None:
        self.recorded = 0

    def __call__(self, call):
        self.recorded += 1
        for _ in range(WARM_UP_CALLS):
            call()
        return call


@pytest.mark.parametrize('device', DEVICES)
def test_a_hundred_updates_from_the_same_steps_and_noise_end_where_those_of_flat_sac_end(device):
    run = Run()
    memory = run.filled()
    flat, sac = FlatSAC(*SIZES, settings(), 0), make(device)
    assert same(flat.state(), sac.state())
    assert sac.take(memory)
    ring = memory.store.sources[0]
    rng = np.random.default_rng(0)
    for _ in range(100):
        slots = rng.integers(0, ring.end, 32)
        steps = ring.steps_in(slots)
        noise = torch.randn(2, 32, ACTION)
        going_on = flat.discount * (1 - torch.tensor(steps.terminated, dtype=torch.float32))
        s, a, r, s2 = map(
            torch.tensor,
            (steps.observations, steps.actions, steps.rewards, steps.next_observations),
        )
        rows = torch.from_numpy(slots).to(sac.device)
        with torch.no_grad():
            flat._step(s, a, r, s2, going_on, noise)
            sac._step(*sac._steps.read(rows), noise.to(sac.device))
    check_close(sac, flat)
    said, expected = sac._take_metrics(), flat._take_metrics()
    for name, total in expected.items():
        torch.testing.assert_close(said[name].cpu(), total, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize('device', DEVICES)
def test_a_burst_depends_on_its_seed_and_on_nothing_before_it(device):
    """So that a restart or another order of slices changes nothing."""
    memory = Run().filled()
    one, other = make(device), make(device)
    for sac in (one, other):
        sac.take(memory)
    replay(one, 5, seed=1)
    torch.manual_seed(77)
    torch.randn(9, device=one.device)
    other.load_state(one.state())
    assert replay(one, 5, seed=2) == replay(other, 5, seed=2)
    assert same(one.state(), other.state())
    replay(one, 5, seed=3), replay(other, 5, seed=4)
    assert not same(one.state(), other.state())


@pytest.mark.parametrize('device', DEVICES)
def test_each_update_draws_steps_and_noise_of_its_own(device):
    """With one and the same noise in every update the updates would be the same, too: the state
    is put back before each.
    """
    sac = make(device)
    run = Run()
    run.steps(1, end='truncated')  # one step, so that noise is all that differs
    run.label('sim', 0, 0, 1)
    sac.take(run.memory)
    state, found = sac.state(), set()
    torch.manual_seed(0)
    for _ in range(10):
        found.add(float(sac.replay(1)['entropy']))
        sac.load_state(state)
    assert len(found) == 10


@pytest.mark.parametrize('device', DEVICES)
def test_states_go_to_flat_sac_through_a_checkpoint_and_back(device, tmp_path):
    sac = make(device)
    sac.take(Run().filled())
    replay(sac, 5)
    path = checkpoints.save(tmp_path, 'learner', 0, sac.state(), {})
    state, _ = checkpoints.load(path)
    assert all(tensor.device.type == 'cpu' for tensor in sac.state().values())
    flat = FlatSAC(*SIZES, settings(), 99)
    flat.load_state(state)
    assert same(flat.state(), sac.state())
    assert weights_bytes(flat.actor) == weights_bytes(sac.actor)
    other = make(device, seed=98)
    other.take(Run().filled())
    other.load_state(flat.state())
    assert replay(sac, 5) == replay(other, 5)
    assert same(other.state(), sac.state())


def test_the_policy_that_is_published_is_the_one_that_learns_as_safetensors():
    sac = make()
    sac.take(Run().filled())
    before = weights_bytes(sac.actor)
    replay(sac, 1)
    assert weights_bytes(sac.actor) != before
    tensors = safetensors.torch.load(weights_bytes(sac.actor))
    assert {tensor.device.type for tensor in tensors.values()} == {'cpu'}


def test_recording_leaves_nothing_behind_and_happens_again_where_a_source_appears():
    run, eager = Run(), Eager()
    sac, plain = make(record=eager), make()
    assert not sac.take(run.memory)
    memory = run.filled()
    before = sac.state()
    for phase in range(3):
        assert sac.take(memory) and plain.take(memory)
        if phase == 0:
            assert same(sac.state(), before)
        assert replay(sac, 5) == replay(plain, 5)
        assert same(sac.state(), plain.state())
        run.steps(10, end='truncated')
    assert eager.recorded == 1
    run.steps(10, 'sim_2', 'truncated')
    sac.take(memory)
    assert eager.recorded == 2


def test_totals_are_the_sums_of_what_each_update_says():
    memory = Run().filled()
    one, other = make(), make()
    one.take(memory), other.take(memory)
    total = replay(one, 6)
    torch.manual_seed(0)
    said = [other.replay(1) for _ in range(6)]
    for name, value in total.items():
        assert value == pytest.approx(sum(float(s[name]) for s in said), rel=1e-5, abs=1e-5)


@pytest.mark.parametrize('device', DEVICES)
def test_a_run_with_its_memory_on_a_device_finishes_and_its_checkpoint_loads(
    device, tmp_path, monkeypatch
):
    """`device=cpu` means FlatSAC in a run: here the other learner takes its place."""
    monkeypatch.setitem(registry.METHODS, 'codetr', FromLabelsOnDevice)
    chosen = tiny(evaluate_every=0, simulators=2, device=device)
    report = in_process.run(chosen, 'a_run', tmp_path)['learner']
    assert report.finished and report.updates > 0
    state, meta = checkpoints.load(checkpoints.latest(tmp_path / 'checkpoints', 'learner'))
    flat = FlatSAC(meta['observation_size'], meta['action_size'], chosen.sac, 1)
    flat.load_state(checkpoints.of_model(state))
    assert checkpoints.digest(flat.actor.state_dict()) == report.policy_sha256
    assert flat.state()['critic_adam.step.0'] == report.updates


@pytest.mark.skipif(torch.cuda.is_available(), reason='there is a GPU here')
@pytest.mark.parametrize('device', ['cuda', 'cuda:1'])
def test_a_gpu_that_is_not_here_is_said_before_anything_is_simulated(device):
    with pytest.raises(DeviceError, match=f'device={device}: torch .* or set device=cpu'):
        in_process.run(tiny(device=device), 'run')


# --------------------------------------------------------------------------------------------
# only where there is a GPU


@needs_gpu
def test_a_gpu_that_is_beyond_the_last_one_is_refused_with_the_last_ones_name():
    count = torch.cuda.device_count()
    with pytest.raises(DeviceError, match=f'the last is cuda:{count - 1}'):
        usable(f'cuda:{count}')


@needs_gpu
def test_replayed_updates_end_where_eager_ones_end():
    """Of the same seed: a graph draws what the same calls would draw."""
    memory = Run().filled()
    eager, recorded = make('cuda', record=lambda call: call), make('cuda')
    for sac in (eager, recorded):
        sac.take(memory)
    for seed in range(20):
        one, other = replay(eager, 5, seed), replay(recorded, 5, seed)
        assert one == pytest.approx(other, rel=1e-4, abs=1e-4)
    check_close(recorded, eager)


@needs_gpu
def test_replays_follow_what_comes_labels_that_change_and_what_is_evicted():
    run = Run(capacity=60)
    eager, recorded = make('cuda', record=lambda call: call), make('cuda')
    for phase in range(6):
        run.steps(20, end='terminated')
        run.memory.evict()
        for number in run.memory.store.sources[0].by_number:
            run.label('sim', number, 0, 15)
        for sac in (eager, recorded):
            sac.take(run.memory)
        assert replay(eager, 5, phase) == pytest.approx(replay(recorded, 5, phase), rel=1e-4)
    check_close(recorded, eager)


@needs_gpu
def test_nobody_waits_for_the_gpu_between_replays():
    sac = make('cuda')
    sac.take(Run().filled())
    replay(sac, 1)
    torch.cuda.set_sync_debug_mode('error')
    try:
        torch.manual_seed(0)
        said = sac.replay(20)
    finally:
        torch.cuda.set_sync_debug_mode('default')
    assert np.isfinite([float(total) for total in said.values()]).all()


@needs_gpu
@pytest.mark.slow
def test_compiled_and_recorded_updates_end_where_plain_ones_end(recwarn):
    memory = Run().filled()
    eager = make('cuda', record=lambda call: call)
    fast = DeviceSAC(*SIZES, settings(compile=True), 0, 'cuda')
    assert not [w for w in recwarn if 'TensorFloat32' in str(w.message)]  # nobody asked for it
    for sac in (eager, fast):
        sac.take(memory)
        replay(sac, 100)
    check_close(fast, eager)
