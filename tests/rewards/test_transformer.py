"""The network made fast, against the one that a reader would write (`plain_transformer`)."""

import numpy as np
import pytest
import torch

from codetr_ros.config import CodetrSettings
from codetr_ros.memory.batches import SegmentBatch
from codetr_ros.rewards import sequence
from codetr_ros.rewards.codetr import Codetr
from codetr_ros.rewards.dropout import add_dropped, draw, keep_mask
from codetr_ros.rewards.transformer import RewardTransformer
from codetr_ros.seeding import generator
from helpers import builders, plain_transformer

O, A, B, L = 5, 3, 4, 6  # noqa: E741


@pytest.fixture(autouse=True)
def double():
    """Double precision: the two forms then differ by nothing but a fault."""
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def settings(**changes) -> CodetrSettings:
    small = {'layers': 2, 'heads': 2, 'embedding': 8, 'initialisation': 'lecun'}
    return builders.tiny().codetr.model_copy(update=small | changes)


def inputs() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    lengths = torch.tensor([L, L, 2, 4])
    return torch.randn(B, L, O), torch.randn(B, L, A), torch.arange(L) < lengths[:, None]


class SameMasks:
    """Drops what the network has dropped, in the same order, from the same seed.

    The network leaves out of its last layer the tokens that are not read. Whatever is dropped
    there must not matter: nothing of it is kept.
    """

    def __init__(self, settings: CodetrSettings) -> None:
        self.settings = settings
        self.before_last = 1 + 3 * (settings.layers - 1)  # the input's, and three in each layer

    def __call__(self, x: torch.Tensor) -> torch.Tensor:
        self.before_last -= 1
        every = 2 if self.settings.tokens == 'pair' and self.before_last < 0 else 1
        read = torch.zeros_like(x)
        drawn = read[..., every - 1 :: every, :]
        drawn.copy_(keep_mask(drawn.shape, self.settings.dropout))
        return x * read


@pytest.mark.parametrize('dropout', [0.0, 0.3])
@pytest.mark.parametrize('weights', ['attention', 'one'])
@pytest.mark.parametrize('tokens', ['pair', 'merged'])
def test_with_the_same_masks_outputs_and_gradients_are_those_of_the_plain_form(
    tokens, weights, dropout
):
    chosen = settings(tokens=tokens, weights=weights, dropout=dropout)
    torch.manual_seed(0)
    network = RewardTransformer(O, A, L, chosen)
    given = inputs()
    found = []
    for plain in (False, True):
        network.zero_grad()
        torch.manual_seed(1)
        if plain:
            drop = SameMasks(chosen) if dropout else lambda x: x
            w, rhat = plain_transformer.forward(network, chosen, *given, drop)
        else:
            w, rhat = network(*given)
        ((w * rhat) * given[2]).square().sum().backward()
        found.append([w, rhat, *(p.grad for p in network.parameters())])
    assert len(found[0]) > 30
    for fast, oracle in zip(*found, strict=True):
        if oracle is None:
            assert fast is None
        else:
            assert oracle.abs().max() > 0
            torch.testing.assert_close(fast, oracle, rtol=1e-6, atol=1e-9)


def test_without_attention_a_pair_is_its_state_alone_and_with_it_the_state_and_the_action_before():
    """The order of the published code: (a_1, s_1, a_2, s_2, ...), read at the states."""
    torch.manual_seed(0)
    network = RewardTransformer(O, A, L, settings(tokens='pair', layers=1)).eval()
    observations, actions, inside = inputs()
    others = torch.randn_like(actions)
    with torch.no_grad():
        attentive = [network(observations, a, inside)[1] for a in (actions, others)]
        earlier = torch.cat([actions[:, :3], others[:, 3:]], 1)
        until = network(observations, earlier, inside)[1]
        network.causal.blocks[0].attention.out.weight.zero_()
        alone = [network(observations, a, inside)[1] for a in (actions, others)]
        moved = network(torch.randn_like(observations), actions, inside)[1]
    assert torch.equal(*alone) and not torch.isclose(moved, alone[0]).any()
    assert not torch.isclose(*attentive).any(), 'a step is read after its action'
    torch.testing.assert_close(until[:, :3], attentive[0][:, :3])


@pytest.mark.parametrize('tokens', ['pair', 'merged'])
def test_without_training_nothing_is_dropped(tokens):
    chosen = settings(tokens=tokens, dropout=0.5)
    network = RewardTransformer(O, A, L, chosen).eval()
    given = inputs()
    with torch.no_grad():
        torch.testing.assert_close(
            network(*given), plain_transformer.forward(network, chosen, *given)
        )


@pytest.mark.parametrize('dropout', [0.0, 0.3])
@pytest.mark.parametrize('tokens', ['pair', 'merged'])
def test_in_bfloat16_outputs_and_gradients_are_nearly_the_same(tokens, dropout):
    torch.set_default_dtype(torch.float32)
    torch.manual_seed(0)
    chosen = settings(tokens=tokens, dropout=dropout, embedding=32)
    found = []
    for precision in ('float32', 'bfloat16'):
        torch.manual_seed(0)
        network = RewardTransformer(O, A, L, chosen.model_copy(update={'precision': precision}))
        given = inputs()
        torch.manual_seed(1)
        w, rhat = network(*given)
        ((w * rhat) * given[2]).square().sum().backward()
        gradient = torch.cat([p.grad.flatten() for p in network.parameters()])
        found.append((w[given[2]], rhat[given[2]], gradient))
    # the gradient is that of a square: small errors of outputs are large ones of it
    for full, half, tolerance in zip(*found, (0.03, 0.03, 0.15), strict=True):
        assert half.dtype == torch.float32 and not torch.equal(full, half)
        assert (half - full).norm() < tolerance * full.norm()


# ------------------------------------------------------------------------------------------- masks


@pytest.mark.parametrize('dropout', [0.01, 0.1, 0.5, 0.9])
def test_masks_keep_each_number_with_the_probability_of_the_setting(dropout):
    torch.manual_seed(0)
    count = 1_000_000
    mask = keep_mask((count // 100, 100), dropout).double()
    kept = mask > 0
    torch.testing.assert_close(mask[kept], torch.full_like(mask[kept], 1 / (1 - dropout)))
    share = kept.double()
    error = (dropout * (1 - dropout) / count) ** 0.5
    assert abs(float(share.mean()) - (1 - dropout)) < 4 * error
    # kept or not says nothing about the neighbours, in either direction, nor about the next mask
    deviation = share - (1 - dropout)
    other = (keep_mask((count // 100, 100), dropout) > 0).double() - (1 - dropout)
    pairs = (
        deviation[1:] * deviation[:-1],
        deviation[:, 1:] * deviation[:, :-1],
        deviation[:, 2:] * deviation[:, :-2],
        deviation * other,
    )
    for products in pairs:
        assert abs(float(products.mean())) < 5 * dropout * (1 - dropout) / count**0.5


def test_integers_are_drawn_from_the_whole_range_and_from_the_seed_alone():
    torch.manual_seed(3)
    first, second = draw(100_001), draw(100_001)
    torch.manual_seed(3)
    assert torch.equal(draw(100_001), first) and not torch.equal(first, second)
    counts = np.bincount((first.numpy() >> 24) + 128, minlength=256)  # of the highest byte
    assert ((counts - 100_001 / 256) ** 2 / (100_001 / 256)).sum() < 350  # chi^2, 255 degrees


def test_what_is_dropped_has_the_same_expectation():
    torch.manual_seed(0)
    h, change = torch.zeros(4, 50_000), torch.ones(4, 50_000)
    assert float(add_dropped(h, change, 0.1).mean()) == pytest.approx(1.0, abs=5e-3)
    assert torch.equal(add_dropped(h, change, 0.0), change)


# ------------------------------------------------------------------------------------------- parts


def batch(rows: int) -> SegmentBatch:
    rng = np.random.default_rng(0)
    lengths = rng.integers(1, 8, rows)
    return SegmentBatch(
        rng.standard_normal((rows, 8, O)).astype(np.float32),
        rng.standard_normal((rows, 7, A)).astype(np.float32),
        lengths,
        np.zeros_like(lengths),
        rng.standard_normal(rows),
    )


class Fixed:
    """A memory that always gives the same batch."""

    def __init__(self, batch: SegmentBatch) -> None:
        self.batch = batch
        self.segments = self.store = self
        self.judgements = None

    def sample(self, *arguments) -> SegmentBatch:
        return self.batch

    def ids(self) -> np.ndarray:
        return np.arange(len(self.batch.values))

    def target_scale(self, kind: str) -> float:
        return 1.5

    def observation_moments(self):
        return np.zeros(O), np.ones(O)


@pytest.mark.parametrize('rows', [1, 5, 8])
def test_a_batch_taken_in_parts_teaches_and_labels_as_in_one_go(monkeypatch, rows):
    torch.set_default_dtype(torch.float32)
    found = []
    for size in (1 << 30, 4000):
        monkeypatch.setattr(sequence, 'ARRAY_BYTES', size)
        made = Codetr(builders.tiny(codetr__dropout=0.0), O, A)
        given = batch(rows)
        assert [len(p.lengths) for p in made._parts(given)] == (
            [rows] if size > 4000 else {1: [1], 5: [2, 2, 1], 8: [2, 2, 2, 2]}[rows]
        )
        memory = Fixed(given)
        made.prepare(memory)
        said = made.gradient_step(memory, generator(0))
        gradients = [p.grad.clone() for p in made.network.parameters()]
        found.append((said, gradients, made.label(given), made.components(given)))
    torch.testing.assert_close(found[0], found[1], rtol=1e-4, atol=1e-6)
