"""The policy network: what it computes, how it travels, and what is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest
import safetensors.torch
import torch

from codetr_ros.policy.acting import ActingPolicy
from codetr_ros.policy.actor import Actor, StandardisedActor, linear_layers, weights_bytes
from codetr_ros.policy.network import LOG_STD_RANGE, NetworkError, describe_network
from codetr_ros.records import Policy

OBS, ACT, HIDDEN = 7, 3, (32, 16)


@pytest.fixture
def actor() -> Actor:
    torch.manual_seed(5)
    actor = Actor(OBS, ACT, HIDDEN)
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))  # biases too
    return actor


def record(actor: Actor, **changes: object) -> Policy:
    policy = Policy(
        run_id='run',
        phase=12,
        version=11,
        sources=('sim',),
        steps=np.array([1000], np.uint32),
        random=False,
        network=describe_network(OBS, ACT, HIDDEN),
        weights=weights_bytes(actor),
    )
    return replace(policy, **changes)


def with_tensors(actor: Actor, **changes: torch.Tensor | None) -> Policy:
    tensors = {**actor.state_dict(), **changes}
    kept = {name: tensor for name, tensor in tensors.items() if tensor is not None}
    return record(actor, weights=safetensors.torch.save(kept))


def observations(count: int) -> np.ndarray:
    return np.random.default_rng(0).standard_normal((count, OBS)).astype(np.float32)


def test_the_acting_policy_acts_as_the_actor_that_was_published(actor: Actor) -> None:
    policy = ActingPolicy.from_record(record(actor), OBS, ACT)
    seen = observations(20)
    noise = np.random.default_rng(1).standard_normal((20, ACT)).astype(np.float32)
    with torch.no_grad():
        mean, log_std = actor(torch.from_numpy(seen))
    sampled = torch.tanh(mean + log_std.exp() * torch.from_numpy(noise)).numpy()
    for i in range(20):
        action = policy.act(seen[i])
        assert action.dtype == np.float32 and action.shape == (ACT,)
        np.testing.assert_allclose(action, torch.tanh(mean[i]).numpy(), atol=1e-6)
        np.testing.assert_allclose(policy.act(seen[i], noise[i]), sampled[i], atol=1e-6)


def test_an_action_never_leaves_the_unit_box_however_large_the_noise(actor: Actor) -> None:
    policy = ActingPolicy.from_record(record(actor), OBS, ACT)
    for size in (-1e6, 1e6):
        action = policy.act(observations(1)[0], np.full(ACT, size, np.float32))
        assert np.all(np.abs(action) <= 1)


def test_where_the_weights_lie_in_memory_does_not_change_a_bit(actor: Actor) -> None:
    straight = ActingPolicy(actor)
    for layer in linear_layers(actor):
        for name in ('weight', 'bias'):
            value = getattr(layer, name).detach()
            crooked = torch.empty(value.numel() + 16)[1:][: value.numel()].view(value.shape)
            setattr(layer, name, torch.nn.Parameter(crooked.copy_(value)))
    assert any(layer.weight.data_ptr() % 64 for layer in linear_layers(actor))
    policy = ActingPolicy(actor)
    assert all(tensor.data_ptr() % 64 == 0 for pair in policy.layers for tensor in pair)
    for seen in observations(50):
        assert np.array_equal(policy.act(seen), straight.act(seen))


def test_what_the_learner_does_next_does_not_change_a_policy_made_before(actor: Actor) -> None:
    policy = ActingPolicy(actor)
    before = policy.act(observations(1)[0])
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.mul_(2)
    assert np.array_equal(policy.act(observations(1)[0]), before)


def test_the_same_weights_give_the_same_bytes(actor: Actor) -> None:
    again = Actor(OBS, ACT, HIDDEN)
    again.load_state_dict(actor.state_dict())
    assert weights_bytes(again) == weights_bytes(actor)


def test_initial_weights_are_orthogonal_with_gain_one_in_each_head() -> None:
    torch.manual_seed(0)
    actor = Actor(OBS, ACT, HIDDEN)
    first, second, heads = linear_layers(actor)
    for layer, gain in ((first, 2), (second, 2), *((head, 1) for head in heads.weight.chunk(2))):
        weight = (layer if isinstance(layer, torch.Tensor) else layer.weight).detach()
        gram = weight.T @ weight if weight.shape[0] > weight.shape[1] else weight @ weight.T
        torch.testing.assert_close(gram, gain * torch.eye(len(gram)), atol=1e-5, rtol=0)
    assert not any(layer.bias.any() for layer in linear_layers(actor))


def test_the_log_standard_deviation_is_clipped_on_both_sides(actor: Actor) -> None:
    with torch.no_grad():
        actor.heads.bias[ACT] = 1e4
        actor.heads.bias[ACT + 1] = -1e4
        _, log_std = actor(torch.from_numpy(observations(4)))
    assert LOG_STD_RANGE == (-10, 2)
    assert torch.all(log_std[:, 0] == 2) and torch.all(log_std[:, 1] == -10)
    policy = ActingPolicy(actor)
    seen, noise = observations(1)[0], np.array([0, 1e4, 0], np.float32)
    mean = np.arctanh(policy.act(seen).astype(np.float64))
    moved = np.arctanh(policy.act(seen, noise).astype(np.float64))
    assert moved[1] - mean[1] == pytest.approx(1e4 * np.exp(-10), rel=1e-3)


def test_the_description_is_canonical_json_that_names_sizes_and_widths() -> None:
    description = describe_network(OBS, ACT, HIDDEN)
    parsed = json.loads(description)
    assert parsed['observation_size'] == OBS and parsed['action_size'] == ACT
    assert parsed['hidden'] == list(HIDDEN)
    assert description == json.dumps(parsed, sort_keys=True, separators=(',', ':'))
    assert (
        len({describe_network(OBS, ACT, h) for h in (HIDDEN, HIDDEN[::-1], (32,), (32, 16, 16))})
        == 4
    )


def stepwise(seen: np.ndarray, first: int, n: int) -> np.ndarray:
    """Observations of consecutive steps, each with how far its segment of n steps is."""
    places = (first + np.arange(len(seen))) % n / n
    return np.concatenate([seen, places[:, None]], 1).astype(np.float32)


def test_a_policy_that_sees_how_far_the_segment_is_counts_from_its_start() -> None:
    torch.manual_seed(3)
    actor = Actor(OBS + 1, ACT, HIDDEN)
    published = record(actor, network=describe_network(OBS, ACT, HIDDEN, segment_steps=4))
    policy = ActingPolicy.from_record(published, OBS, ACT, delay=4)
    seen = observations(9)
    with torch.no_grad():
        mean, _ = actor(torch.from_numpy(stepwise(seen, 6, 4)))
    acted = [policy.act(o, step=t) for t, o in enumerate(seen, 6)]
    np.testing.assert_allclose(acted, mean.tanh().numpy(), atol=1e-6)
    with pytest.raises(NetworkError, match='give it the number of the step'):
        policy.act(seen[0])


@pytest.mark.parametrize('named', ['4', '-4', '4.0', 'true', 'null', '"5"', '[5]'])
def test_a_policy_for_other_segments_is_refused(named: str) -> None:
    network = describe_network(OBS, ACT, HIDDEN, segment_steps=5).replace('s":5', f's":{named}')
    published = record(Actor(OBS + 1, ACT, HIDDEN), network=network)
    with pytest.raises(NetworkError, match=r'segments of .* steps, where they have 5'):
        ActingPolicy.from_record(published, OBS, ACT, delay=5)


def test_the_moments_of_the_observations_travel_with_the_policy() -> None:
    torch.manual_seed(4)
    actor = StandardisedActor(OBS, ACT, HIDDEN)
    with torch.no_grad():
        actor.mean.weight.mul_(100)
        actor.log_std.copy_(torch.tensor([-1.0, 0.5, 2.5]))  # the last is beyond the clip
        actor.observation_mean.copy_(torch.linspace(-1, 1, OBS))
        actor.observation_deviation.copy_(torch.linspace(0.01, 2, OBS))  # some beyond the clip
    kind = 'standardised_tanh_gaussian_mlp'
    published = record(actor, network=describe_network(OBS, ACT, HIDDEN, kind=kind))
    policy = ActingPolicy.from_record(published, OBS, ACT)
    seen = observations(9)
    noise = np.random.default_rng(1).standard_normal((9, ACT)).astype(np.float32)
    mean, deviation = np.linspace(-1, 1, OBS), np.linspace(0.01, 2, OBS)
    x = torch.from_numpy(np.clip((seen - mean) / deviation, -10, 10)).float()
    assert x.abs().max() == 10
    mean, log_std = actor(x)  # what the learner takes the policy for
    assert log_std.tolist() == [-1.0, 0.5, 2.0]
    for layer in linear_layers(actor)[:-1]:
        x = torch.tanh(layer(x))
    torch.testing.assert_close(mean, actor.mean(x))
    u = mean + log_std.exp() * torch.from_numpy(noise)
    acted = [policy.act(o, e) for o, e in zip(seen, noise, strict=True)]
    np.testing.assert_allclose(acted, u.tanh().detach().numpy(), atol=1e-5)


def test_a_policy_of_another_kind_is_another_architecture(actor: Actor) -> None:
    for kind in ('"gru"', '["gru"]', 'null', '"standardised_tanh_gaussian_mlp"'):
        network = describe_network(OBS, ACT, HIDDEN).replace('"tanh_gaussian_mlp"', kind)
        with pytest.raises(NetworkError, match='another architecture'):
            ActingPolicy.from_record(record(actor, network=network), OBS, ACT)


def test_a_policy_for_another_task_is_refused_and_both_architectures_are_named(
    actor: Actor,
) -> None:
    with pytest.raises(NetworkError) as refused:
        ActingPolicy.from_record(record(actor), OBS + 1, ACT)
    message = str(refused.value)
    assert (
        describe_network(OBS, ACT, HIDDEN) in message
        and describe_network(OBS + 1, ACT, HIDDEN) in message
    )
    assert 'policy of phase 12, version 11' in message


def test_another_activation_is_another_architecture(actor: Actor) -> None:
    other = describe_network(OBS, ACT, HIDDEN).replace('relu', 'tanh')
    with pytest.raises(NetworkError, match='another architecture'):
        ActingPolicy.from_record(record(actor, network=other), OBS, ACT)


@pytest.mark.parametrize('network', ['', 'MLP', '[]', '{}', 'null'])
def test_a_description_in_another_language_is_quoted(actor: Actor, network: str) -> None:
    with pytest.raises(NetworkError, match='not one of this version') as refused:
        ActingPolicy.from_record(record(actor, network=network), OBS, ACT)
    assert repr(network) in str(refused.value)


@pytest.mark.parametrize('hidden', ['[]', '[0]', '[10000000]', '[1.5]', '["8"]', '[true]', '256'])
def test_impossible_widths_are_refused_before_a_network_is_made(actor: Actor, hidden: str) -> None:
    network = describe_network(OBS, ACT, HIDDEN).replace('[32,16]', hidden)
    with pytest.raises(NetworkError, match='names hidden widths'):
        ActingPolicy.from_record(record(actor, network=network), OBS, ACT)


@pytest.mark.parametrize(
    ('changes', 'said'),
    [
        ({'heads.bias': None}, "missing weights \\['heads.bias'\\], unknown weights \\[\\]"),
        ({'more': torch.zeros(1)}, "missing weights \\[\\], unknown weights \\['more'\\]"),
        ({'heads.bias': torch.zeros(ACT)}, r"'heads.bias' is .*\(3,\).*, expected .*\(6,\)"),
        ({'heads.bias': torch.zeros(2 * ACT).double()}, "is .*float64.*, expected .*float32'"),
        ({'heads.bias': torch.tensor([0.0] * 5 + [torch.nan])}, '1 of 6 numbers .*heads.bias'),
        ({'heads.bias': torch.tensor([0.0] * 4 + [torch.inf] * 2)}, '2 of 6 numbers .*not finite'),
    ],
)
def test_weights_that_do_not_fit_are_refused(
    actor: Actor, changes: dict[str, torch.Tensor | None], said: str
) -> None:
    with pytest.raises(NetworkError, match=said):
        ActingPolicy.from_record(with_tensors(actor, **changes), OBS, ACT)


@pytest.mark.parametrize('keep', [0, 7, 100, -1])
def test_weights_that_are_cut_short_are_refused(actor: Actor, keep: int) -> None:
    cut = weights_bytes(actor)[:keep]
    with pytest.raises(NetworkError, match=f'its {len(cut)} bytes of weights are not safetensors'):
        ActingPolicy.from_record(record(actor, weights=cut), OBS, ACT)


def test_a_random_policy_has_nothing_to_act_with(actor: Actor) -> None:
    with pytest.raises(NetworkError, match='is random'):
        ActingPolicy.from_record(record(actor, random=True, weights=b''), OBS, ACT)
