"""The fast update, held against the plain form and, for its gradients, against autograd."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch

from codetr_ros.config import SacSettings
from codetr_ros.learners import flat_sac
from codetr_ros.learners.flat_sac import FlatSAC
from codetr_ros.learners.sac import SAC
from codetr_ros.memory.batches import StepBatch
from codetr_ros.policy.actor import weights_bytes
from codetr_ros.runs.checkpoints import digest
from helpers.tensors import crooked, same

torch.set_num_threads(1)  # a second thread is slower at these sizes

# hidden widths, observation size, action size, batch
SIZES = [((24, 16), 5, 3, 32), ((16,), 3, 1, 8), ((8, 9, 10), 4, 2, 7), ((64, 64), 27, 8, 64)]

ADAMS = ('critic_adam', 'actor_adam', 'temperature_adam')


def settings(hidden: tuple[int, ...] = (24, 16), batch: int = 32) -> SacSettings:
    return SacSettings(
        hidden=hidden,
        batch=batch,
        actor_learning_rate=3e-3,  # each another, so that none can stand for another
        critic_learning_rate=5e-3,
        temperature_learning_rate=7e-3,
        discount=0.9,
        tau=0.05,
        initial_temperature=0.5,
        compile=False,
    )


def make_batch(rows: int, observation: int, action: int, seed: int) -> StepBatch:
    rng = np.random.default_rng(seed)
    dtype = np.float64 if torch.get_default_dtype() == torch.float64 else np.float32
    return StepBatch(
        observations=rng.standard_normal((rows, observation)).astype(dtype),
        actions=rng.uniform(-1, 1, (rows, action)).astype(dtype),
        rewards=rng.standard_normal(rows).astype(dtype),
        next_observations=rng.standard_normal((rows, observation)).astype(dtype),
        terminated=rng.random(rows) < 0.3,
    )


def pair(hidden, observation, action, batch) -> tuple[SAC, FlatSAC]:
    chosen = settings(hidden, batch)
    return SAC(observation, action, chosen, 3), FlatSAC(observation, action, chosen, 3)


def burst(sac: FlatSAC, updates: int, batch: StepBatch) -> dict[str, torch.Tensor]:
    torch.manual_seed(0)
    return sac.burst(updates, lambda rows: batch)


def part(batch: StepBatch, rows: slice) -> StepBatch:
    return StepBatch(*(getattr(batch, name)[rows] for name in StepBatch.__dataclass_fields__))


def check_close(flat: SAC, plain: SAC, tolerance: float) -> None:
    mine, theirs = flat.state(), plain.state()
    assert mine.keys() == theirs.keys()
    for name, tensor in theirs.items():
        largest = max(1e-3, float(tensor.abs().max()))
        error = float((mine[name] - tensor).abs().max()) / largest
        assert error < tolerance, f'{name}: {error}'


@pytest.mark.parametrize(('hidden', 'observation', 'action', 'batch'), SIZES)
def test_a_hundred_updates_end_where_those_of_the_plain_form_end(
    hidden, observation, action, batch
):
    plain, flat = pair(hidden, observation, action, batch)
    assert same(plain.state(), flat.state())
    for index in range(100):
        said = []
        for sac in (plain, flat):
            torch.manual_seed(index)
            said.append(sac.update(make_batch(batch, observation, action, index)))
        torch.testing.assert_close(said[1], said[0], rtol=1e-4, atol=1e-4)
    check_close(flat, plain, 1e-4)


@pytest.mark.parametrize(('hidden', 'observation', 'action', 'batch'), SIZES)
def test_in_double_precision_the_two_forms_are_one(double, hidden, observation, action, batch):
    plain, flat = pair(hidden, observation, action, batch)
    for index in range(20):
        for sac in (plain, flat):
            torch.manual_seed(index)
            sac.update(make_batch(batch, observation, action, index))
    check_close(flat, plain, 1e-9)


@pytest.mark.parametrize(('hidden', 'observation', 'action', 'batch'), SIZES)
def test_what_critics_alone_see_never_reaches_the_actor(
    double, hidden, observation, action, batch
):
    chosen = settings(hidden, batch)
    plain = SAC(observation, action, chosen, 3, progress=2)
    flat = FlatSAC(observation, action, chosen, 3, progress=2)
    for index in range(10):
        for sac in (plain, flat):
            torch.manual_seed(index)
            sac.update(make_batch(batch, observation + 2, action, index))
    # the plain form's softplus is linear from 20 on: exp(-20) = 2e-9 is missing there
    check_close(flat, plain, 1e-8)
    widths = [sac.state()['critic.0'].shape[1] for sac in (plain, flat)]
    assert widths == [observation + 2 + action] * 2
    assert plain.actor(torch.zeros(1, observation))[0].shape == (1, action)


class Recorder:
    """Stands where a step of Adam would be, and keeps the gradients."""

    def __init__(self, adam: flat_sac.FlatAdam) -> None:
        self.adam = adam
        adam.descend = self.keep

    def keep(self, gradients) -> None:
        self.flat = torch.cat([g.reshape(-1) for g in gradients])


@pytest.mark.parametrize(('hidden', 'observation', 'action', 'batch'), SIZES)
def test_gradients_by_hand_are_those_of_autograd(double, hidden, observation, action, batch):
    plain, flat = pair(hidden, observation, action, batch)
    with torch.no_grad():  # log standard deviations on both sides of their clip
        heads = (plain.actor.heads.bias, flat.actor.heads.bias)
        for bias in heads:
            bias[action:] = torch.linspace(-10.2, 2.2, action) if action > 1 else 2.0
    found: dict[str, torch.Tensor] = {}
    for name in ADAMS:
        optimiser = getattr(plain, name)

        def keep(loss, name=name, optimiser=optimiser):
            gradients = torch.autograd.grad(loss, optimiser.parameters)
            found[name] = torch.cat([g.reshape(-1) for g in gradients])

        optimiser.step = keep
    recorders = {name: Recorder(getattr(flat, name)) for name in ADAMS}
    for sac in (plain, flat):
        torch.manual_seed(0)
        sac.update(make_batch(batch, observation, action, 0))
    assert found.keys() == recorders.keys()
    for name, gradient in found.items():
        assert gradient.any()
        torch.testing.assert_close(recorders[name].flat, gradient, rtol=1e-7, atol=1e-9)


def test_a_state_goes_from_one_form_to_the_other_and_back():
    plain, flat = pair(*SIZES[0])
    for index in range(5):
        torch.manual_seed(index)
        flat.update(make_batch(32, 5, 3, index))
    state = safetensors.torch.load(safetensors.torch.save(flat.state()))
    plain.load_state(state)
    assert same(plain.state(), flat.state())
    for index in range(5, 10):
        for sac in (plain, flat):
            torch.manual_seed(index)
            sac.update(make_batch(32, 5, 3, index))
    check_close(flat, plain, 1e-5)
    other = FlatSAC(5, 3, settings(), seed=99)
    other.load_state(plain.state())
    assert same(other.state(), plain.state())


def test_a_saved_learner_goes_on_bit_for_bit():
    one, other = FlatSAC(5, 3, settings(), 0), FlatSAC(5, 3, settings(), 99)
    batch = make_batch(32 * 7, 5, 3, 0)
    burst(one, 7, batch)
    other.load_state(one.state())
    assert burst(one, 7, batch) == burst(other, 7, batch)
    assert same(one.state(), other.state())


def test_the_same_seed_gives_the_same_bits_and_another_seed_does_not():
    batch = make_batch(32 * 7, 5, 3, 0)
    states = []
    for seed in (4, 4, 5):
        sac = FlatSAC(5, 3, settings(), seed)
        burst(sac, 7, batch)
        states.append(sac.state())
    assert same(states[0], states[1]) and not same(states[0], states[2])


def test_a_burst_is_its_updates_one_by_one_and_its_totals_their_sums():
    """Batches of a multiple of 8 numbers: torch draws noise in blocks."""
    one, other = FlatSAC(5, 3, settings(), 0), FlatSAC(5, 3, settings(), 0)
    batch = make_batch(32 * 70, 5, 3, 0)  # more than are drawn at once
    asked = []

    def draw(rows: int) -> StepBatch:
        start = sum(asked)
        asked.append(rows)
        return part(batch, slice(start, start + rows))

    torch.manual_seed(0)
    total = one.burst(70, draw)
    torch.manual_seed(0)
    said = [other.update(part(batch, slice(32 * i, 32 * (i + 1)))) for i in range(70)]
    assert asked == [64 * 32, 6 * 32]
    assert same(one.state(), other.state())
    for name, value in total.items():
        torch.testing.assert_close(value, torch.stack([s[name] for s in said]).sum())


def test_where_a_batch_lies_in_memory_does_not_change_a_bit():
    one, other = (FlatSAC(5, 3, settings((9, 9), 7), 4) for _ in range(2))
    batch = make_batch(21, 5, 3, 0)
    moved = StepBatch(*(crooked(getattr(batch, f)) for f in StepBatch.__dataclass_fields__))
    burst(one, 3, batch)
    burst(other, 3, moved)
    assert same(one.state(), other.state())


def test_the_actor_that_is_published_is_the_one_that_learns():
    sac = FlatSAC(5, 3, settings(), 0)
    before, state = weights_bytes(sac.actor), sac.state()
    sac.update(make_batch(32, 5, 3, 0))
    assert weights_bytes(sac.actor) != before
    changed = {n for n, tensor in sac.state().items() if not torch.equal(tensor, state[n])}
    assert changed == state.keys()


def compiled_pair(hidden, observation, action, batch) -> tuple[SAC, FlatSAC]:
    chosen = settings(hidden, batch)
    fast = FlatSAC(observation, action, chosen.model_copy(update={'compile': True}), 3)
    return SAC(observation, action, chosen, 3), fast


@pytest.mark.slow
@pytest.mark.parametrize(('hidden', 'observation', 'action', 'batch'), [SIZES[0], SIZES[2]])
def test_a_hundred_compiled_updates_end_where_those_of_the_plain_form_end(
    hidden, observation, action, batch
):
    plain, flat = compiled_pair(hidden, observation, action, batch)
    assert same(plain.state(), flat.state())  # compiling left nothing behind
    for index in range(100):
        said = []
        for sac in (plain, flat):
            torch.manual_seed(index)
            said.append(sac.update(make_batch(batch, observation, action, index)))
        torch.testing.assert_close(said[1], said[0], rtol=1e-4, atol=1e-4)
    check_close(flat, plain, 1e-4)


@pytest.mark.slow
def test_what_is_compiled_at_the_start_serves_every_update():
    _, sac = compiled_pair(*SIZES[0])
    with torch._dynamo.config.patch(error_on_recompile=True):
        sac.update(make_batch(32, 5, 3, 0))
        burst(sac, 64, make_batch(32 * 64, 5, 3, 0))


COMPILED_BURST = """
import sys
sys.path[:0] = sys.argv[1:]
from test_flat_sac import compiled_pair, SIZES, burst, make_batch
from codetr_ros.runs.checkpoints import digest
_, sac = compiled_pair(*SIZES[0])
burst(sac, 64, make_batch(32 * 64, 5, 3, 0))
print(digest(sac.state()))
"""


@pytest.mark.slow
def test_compiled_updates_make_the_same_bits_in_another_process():
    _, sac = compiled_pair(*SIZES[0])
    burst(sac, 64, make_batch(32 * 64, 5, 3, 0))
    here = Path(__file__).parent
    command = [sys.executable, '-c', COMPILED_BURST, str(here), str(here.parent)]
    said = subprocess.run(command, capture_output=True, text=True, check=True, timeout=250)
    assert said.stdout.split()[-1] == digest(sac.state())
