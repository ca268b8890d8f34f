"""What lies on a device of the memory D, held against the memory itself."""

from collections import Counter

import numpy as np
import pytest
import torch

from codetr_ros.memory import on_device
from codetr_ros.memory.on_device import DeviceMemory
from codetr_ros.system.devices import DeviceError
from helpers.devices import ACTION, OBSERVATION, Run, needs_gpu

DISCOUNT = 0.9
DEVICES = ['cpu', pytest.param('cuda', marks=needs_gpu)]


def mirror(run: Run, device: str = 'cpu') -> DeviceMemory:
    return DeviceMemory(run.memory, DISCOUNT, torch.device(device))


def check(steps: DeviceMemory, run: Run) -> None:
    """Every step that is held lies in its row, and exactly the labelled ones can be drawn."""
    offset, labelled = 0, []
    for ring in run.memory.store.sources:
        slots = np.arange(ring.start, ring.end) % ring.capacity
        held = ring.steps_in(slots)
        s, a, r, s2, going_on = (
            part.cpu().numpy()
            for part in steps.read(torch.from_numpy(slots + offset).to(steps.rows.device))
        )
        np.testing.assert_array_equal(s, held.observations)
        np.testing.assert_array_equal(a, held.actions)
        np.testing.assert_array_equal(r, held.rewards)
        np.testing.assert_array_equal(s2, held.next_observations)
        np.testing.assert_array_equal(going_on, np.where(held.terminated, 0, np.float32(DISCOUNT)))
        labelled += (slots[np.isfinite(held.rewards)] + offset).tolist()
        offset += ring.capacity
    if labelled:
        drawn = steps.draw(len(labelled) * 30).cpu()
        assert set(drawn.tolist()) == set(labelled)  # one is missed in one of 10^13 / n runs


@pytest.mark.parametrize('device', DEVICES)
@pytest.mark.parametrize('at_once', [7, 65_536])
def test_it_follows_steps_labels_relabels_evictions_and_a_ring_that_wraps(
    device, at_once, monkeypatch
):
    monkeypatch.setattr(on_device, 'COPIED_AT_ONCE', at_once)
    run = Run(capacity=60)
    steps = mirror(run, device)
    for phase in range(12):  # 24 steps each: more than four times around
        run.steps(8)  # goes on with the episode that the phase before left unfinished
        run.steps(9, end='terminated')
        run.steps(7, end='truncated' if phase % 2 else '')
        run.memory.evict()
        for number, episode in run.memory.store.sources[0].by_number.items():
            if phase % 3 or number % 2:
                run.label('sim', number, 0, min(8, episode.steps))
        assert steps.update() == (phase > 0)
        check(steps, run)
    assert run.memory.store.sources[0].start > run.memory.store.sources[0].capacity


@pytest.mark.parametrize('device', DEVICES)
def test_it_follows_several_sources_and_one_that_appears_later(device):
    run = Run(capacity=60)
    steps = mirror(run, device)
    for phase in range(6):
        names = ['sim', 'another'] if phase < 3 else ['sim', 'a third', 'another']
        for name in names:
            run.steps(10, name, 'truncated')
        run.memory.evict()
        for ring in run.memory.store.sources:
            for number in ring.by_number:
                run.label(ring.name, number, 2, 5)
        assert steps.update() == (phase not in {0, 3})  # rows move when a source appears
        check(steps, run)


def test_what_is_drawn_follows_an_update_without_another_call_being_recorded():
    """The number of labelled steps is read where it lies, as a recorded draw would."""
    run = Run()
    steps = mirror(run)
    run.steps(20, end='truncated')
    run.label('sim', 0, 0, 1)
    steps.update()
    count, labelled = steps._count, steps._labelled
    assert set(steps.draw(50).tolist()) == {0}
    run.label('sim', 0, 0, 3)
    steps.update()
    assert steps._count is count and steps._labelled is labelled
    assert set(steps.draw(200).tolist()) == {0, 1, 2}


def test_labelled_steps_are_drawn_uniformly_and_no_others():
    run = Run()
    run.filled(episodes=4, length=20)
    run.steps(20, end='truncated')  # never labelled
    steps = mirror(run)
    steps.update()
    torch.manual_seed(0)
    draws = 40_000
    counts = Counter(steps.draw(draws).tolist())
    assert set(counts) == set(range(80))
    expected = draws / 80
    chi_square = sum((n - expected) ** 2 / expected for n in counts.values())
    # 79 degrees of freedom: mean 79, standard deviation 12.6
    assert 40 < chi_square < 130


def test_the_same_seed_draws_the_same_steps_and_the_next_draw_others():
    run = Run()
    run.filled()
    steps = mirror(run)
    steps.update()
    torch.manual_seed(1)
    first, second = steps.draw(32), steps.draw(32)
    assert not torch.equal(first, second)
    torch.manual_seed(1)
    assert torch.equal(steps.draw(32), first)


def test_a_device_without_room_says_how_much_is_wanted_and_what_to_lower():
    run = Run()
    run.filled()
    for ring in run.memory.store.sources:
        ring.capacity = 1 << 50
    message = r'device=cpu: no room for \d{16} steps of \d+ bytes.* lower memory_steps'
    with pytest.raises(DeviceError, match=message):
        mirror(run).update()


def test_a_row_takes_the_bytes_it_states():
    run = Run()
    run.filled()
    steps = mirror(run)
    steps.update()
    assert steps.rows[0].nbytes == 4 * (2 * OBSERVATION + ACTION + 2)
