"""Load stretches of bags into memories D as a stream: only the wanted steps are held."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from codetr_ros.bags.dropped import undropped_entries
from codetr_ros.bags.reader import Bag
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.offline.cutting import Stretch
from codetr_ros.offline.episodes import Key, sound
from codetr_ros.offline.errors import FitError
from codetr_ros.records import F32, CompositeReward, Transitions, TrueRewards

SOURCE = 'data'
"""Name under which a memory holds the steps of all sources, stretch after stretch."""


@dataclass
class Loaded:
    """A memory, with the stretch behind each of its episodes."""

    memory: Trajectories
    stretches: list[Stretch]


class _Filling:
    """A stretch whose steps are arriving; takes memory from the first step on."""

    def __init__(self, stretch: Stretch, sizes: tuple[int, int]) -> None:
        self.stretch = stretch
        self.filled = 0
        self._sizes = sizes

    def take(self, chunk: Transitions) -> bool:
        """Take the new steps of a chunk; returns whether the stretch is whole now."""
        begin = self.stretch.first + self.filled - chunk.first_step
        end = min(chunk.steps, self.stretch.first + self.stretch.steps - chunk.first_step)
        if begin < 0 or end <= begin:
            return False
        if not self.filled:
            self.observations = np.empty((self.stretch.steps + 1, self._sizes[0]), np.float32)
            self.actions = np.empty((self.stretch.steps, self._sizes[1]), np.float32)
        upto = self.filled + end - begin
        self.observations[self.filled : upto + 1] = chunk.observations[begin : end + 1]
        self.actions[self.filled : upto] = chunk.actions[begin:end]
        self.filled = upto
        return upto == self.stretch.steps


Places = dict[tuple[Key, int], list[Stretch]]
"""Stretches by their source and episode."""


def load(
    bags: Sequence[Bag],
    wanted: Sequence[Stretch],
    sizes: tuple[int, int],
    delay: int,
    true_rewards: bool = False,
) -> Loaded:
    """Read stretches into a new memory, in one pass over the bags that hold them.

    Args:
        bags: all bags, in the order of the index.
        wanted: the stretches; the memory has room for these, and no more is ever held.
        sizes: of observations and actions.
        delay: steps of the longest segment.
        true_rewards: whether to hold the environment's own rewards too, NaN where a bag has none.

    Raises:
        BagError: a bag cannot be read.
        FitError: a bag has changed since it was indexed.
    """
    capacity = max(1, sum(s.steps for s in wanted))
    loaded = Loaded(Trajectories(*sizes, delay, capacity, 0, true_rewards, regular=False), [])
    true: dict[Stretch, F32] = {}
    for number, bag in enumerate(bags):
        places: Places = defaultdict(list)
        for stretch in wanted:
            if stretch.key.bag == number:
                places[stretch.key, stretch.episode].append(stretch)
        if places:
            _load(bag, number, places, sizes, loaded, true if true_rewards else None)
    for episode, stretch in enumerate(loaded.stretches):
        if stretch in true:
            loaded.memory.append_true_rewards(
                TrueRewards(
                    run_id='',
                    source=SOURCE,
                    sequence=episode,
                    phase=0,
                    episode=episode,
                    first_step=0,
                    rewards=true[stretch],
                )
            )
    return loaded


def _load(
    bag: Bag,
    number: int,
    places: Places,
    sizes: tuple[int, int],
    loaded: Loaded,
    true: dict[Stretch, F32] | None,
) -> None:
    due = {place: [_Filling(s, sizes) for s in some] for place, some in places.items()}
    kinds = (Transitions,) if true is None else (Transitions, TrueRewards)
    for entry in undropped_entries(bag, kinds):
        record = entry.record
        assert isinstance(record, Transitions | TrueRewards)
        place = (Key(number, record.run_id, record.source), record.episode)
        if isinstance(record, TrueRewards):
            for stretch in places.get(place, ()):
                _take_true(stretch, record, true if true is not None else {})
        elif place in due and sound(record):
            for filling in list(due[place]):
                if filling.take(record):
                    due[place].remove(filling)
                    _add(filling, loaded)
    if lacking := [place for place, some in due.items() if some]:
        raise FitError(
            f'{bag.path} has changed since it was indexed: steps of {len(lacking)} episodes are '
            'gone. Fit a bag that nobody writes to'
        )


def _add(filling: _Filling, loaded: Loaded) -> None:
    stretch, episode = filling.stretch, len(loaded.stretches)
    loaded.memory.append(
        Transitions(
            run_id='',
            source=SOURCE,
            sequence=episode,
            phase=0,
            episode=episode,
            first_step=0,
            steps=stretch.steps,
            observations=filling.observations,
            actions=filling.actions,
            terminated=False,
            truncated=True,
            phase_end=False,
            scores_due=0,
        )
    )
    for first, length, value in zip(*(part.tolist() for part in stretch.segments), strict=True):
        loaded.memory.score(
            CompositeReward(
                run_id='',
                source=SOURCE,
                scorer='',
                sequence=0,
                episode=episode,
                first_step=first - stretch.first,
                length=length,
                value=value,
            )
        )
    loaded.stretches.append(stretch)


def _take_true(stretch: Stretch, record: TrueRewards, true: dict[Stretch, F32]) -> None:
    low = max(record.first_step, stretch.first)
    high = min(record.first_step + len(record.rewards), stretch.first + stretch.steps)
    if low < high:
        mine = true.setdefault(stretch, np.full(stretch.steps, np.nan, np.float32))
        mine[low - stretch.first : high - stretch.first] = record.rewards[
            low - record.first_step : high - record.first_step
        ]


def newest(stretches: Sequence[Stretch], steps: int) -> Iterator[Stretch]:
    """The last stretches that have at most this many steps together, but always one."""
    held = 0
    for stretch in reversed(stretches):
        if held and held + stretch.steps > steps:
            return
        held += stretch.steps
        yield stretch
