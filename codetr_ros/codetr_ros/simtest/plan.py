"""What happens in a simulated run: its settings and its troubles, all drawn from a seed."""

import random
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

from codetr_ros.config import Settings
from codetr_ros.simtest.disks import Trouble
from codetr_ros.simtest.network import LEASE, Partition, Weather
from codetr_ros.simtest.place import Pace
from codetr_ros.simtest.task import TASK

DEADLINE = 60.0
"""How long a node waits for others [s of virtual time]: the default of `peer_deadline`."""
BACK = 3.0
"""Seconds until a node is there again that was killed within a call of its disk."""
BUSY = 8.0
"""Troubles begin within so many seconds, which a run without troubles takes at most."""

_SMALL: dict[str, Any] = {
    'task': TASK,
    'delay': 3,
    'steps': 24,
    'phase_steps': 8,
    'warmup_steps': 8,
    'evaluate_every': 8,
    'evaluate_episodes': 1,
    'memory_steps': 20,  # fewer than the run has: whole episodes leave
    'threads': '1',
    'sac.compile': False,
    'sac.hidden': (4,),
    'sac.batch': 4,
    'rrd.hidden': (4,),
    'rrd.subsequences': 2,
    'rrd.subsequence_steps': 2,
    'rrd.first_gradient_steps': 2,
    'rrd.gradient_steps': 1,
}
_CHANGES: tuple[dict[str, Any], ...] = (
    {'method': 'none'},
    {'method': 'uniform', 'simulators': 2},
    {'method': 'rrd'},
    {'method': 'evidence', 'simulators': 2},
    {'method': 'none', 'overlap': True},
    {'method': 'rrd', 'overlap': True, 'simulators': 2},
    {'method': 'uniform', 'envs': 2, 'delay': '2:4'},
    {'method': 'uniform', 'simulators': 4, 'delay': 'episode', 'evaluate_every': 0},
)


@cache
def all_settings() -> tuple[Settings, ...]:
    """The runs that are simulated: as small as they can be, and different."""
    return tuple(Settings().changed(_SMALL | changes) for changes in _CHANGES)


@dataclass(frozen=True)
class Death:
    """A node is killed, and started again.

    Attributes:
        name: of the node.
        at: when [s].
        seconds: until it is there again.
        power: whether its machine loses its power: a recorder then loses what it has not synced,
            and the newest checkpoint of a learner or reward node is torn.
    """

    name: str
    at: float
    seconds: float
    power: bool = False


@dataclass(frozen=True)
class Plan:
    """A simulated run and its troubles.

    Attributes:
        seed: from which all of it is drawn.
        settings: of the run.
        weather: how the network behaves.
        paces: how quickly each node works, by name.
        disk: what is wrong with the recorder's disk.
        checkpoints: what is wrong with the disk of the checkpoints.
        heals: whether the run must end as if nothing had happened; else it may also end by an
            error that names its cause.
        leave_out_after: seconds of silence after which a source is left out of a phase; 0: never.
        deaths: nodes that are killed, and come back.
    """

    seed: int
    settings: Settings
    weather: Weather
    paces: dict[str, Pace]
    disk: Trouble = field(default_factory=Trouble)
    heals: bool = True
    leave_out_after: float = 0.0
    deaths: tuple[Death, ...] = ()
    checkpoints: Trouble = field(default_factory=Trouble)

    @property
    def kills(self) -> bool:
        """Whether nodes are killed."""
        within = any(each.kills_in is not None for each in (self.disk, self.checkpoints))
        return within or bool(self.deaths)

    @property
    def calm(self) -> bool:
        """Whether messages only take their time, and nothing else happens."""
        weather = self.weather
        return not (
            weather.doubled
            or weather.lost
            or weather.overrun
            or weather.unanswered
            or weather.strangers
            or weather.lies
            or weather.partitions
            or any(pace.stalls for pace in self.paces.values())
            or self.disk != Trouble()
            or self.checkpoints != Trouble()
            or self.deaths
        )

    @property
    def longest(self) -> float:
        """When even the longest wait must have ended [s]."""
        return 20 * BUSY + 6 * DEADLINE + self.silent

    @property
    def silent(self) -> float:
        """How long nodes stall, are dead or do not reach each other, all together [s]."""
        stalls = sum(length for pace in self.paces.values() for _, length in pace.stalls)
        dead = sum(each.seconds for each in self.deaths)
        dead += BACK * sum(each.kills_in is not None for each in (self.disk, self.checkpoints))
        return stalls + dead + sum(each.seconds for each in self.weather.partitions)

    def in_words(self) -> list[str]:
        """What is planned, for people."""
        settings, weather = self.settings, self.weather
        lines = [
            f'method {settings.method}, {settings.simulators} simulators of {settings.envs}, '
            f'overlap {settings.overlap}, delay {settings.delay}',
            f'messages take {weather.delay:g} s'
            f'{", overtake each other" if weather.reorder else ""}, {weather.doubled:.0%} arrive '
            f'twice, {weather.lost:.0%} never',
        ]
        if weather.overrun:
            lines.append(f'{weather.overrun:.0%} never arrive at the recorder')
        if weather.unanswered:
            lines.append(f'{weather.unanswered:.0%} of questions and answers never arrive')
        if weather.strangers:
            lines.append(f'{weather.strangers:.0%} come once more as of another run')
        if weather.lies:
            lines.append(f'of {weather.lies:.0%} of steps and scores forged ones come first')
        lines += [
            f'from {p.begin:.1f} s for {p.seconds:.1f} s {", ".join(sorted(p.apart))} and the '
            'others do not reach each other'
            for p in weather.partitions
        ]
        for name, pace in self.paces.items():
            if pace.begins > 1:
                lines.append(f'{name} starts at {pace.begins:.1f} s')
            if pace.slice_seconds > 0.5:
                lines.append(f'{name} takes {pace.slice_seconds:.1f} s for a slice')
            lines += [f'{name} stalls at {a:.1f} s for {b:.1f} s' for a, b in pace.stalls]
        for whose, disk in (('the recorder', self.disk), ('the checkpoints', self.checkpoints)):
            if disk.room is not None:
                lines.append(f'the disk of {whose} has room for {disk.room} bytes')
            if disk.syncs is not None:
                lines.append(f'the disk of {whose} syncs {disk.syncs} times')
            if disk.kills_in is not None:
                power = ', with the power of its machine' if disk.power else ''
                lines.append(
                    f'who writes to the disk of {whose} is killed in call {disk.kills_in}{power}'
                )
        lines += [
            f'{death.name} is killed at {death.at:.1f} s for {death.seconds:.1f} s'
            f'{", and its machine loses its power" if death.power else ""}'
            for death in self.deaths
        ]
        if self.leave_out_after:
            lines.append(f'who is silent for {self.leave_out_after:.1f} s is left out')
        lines.append('must end as if nothing had happened' if self.heals else 'may fail by name')
        return lines


def names_of(settings: Settings) -> dict[str, str]:
    """The nodes of a run: role by name."""
    roles = dict.fromkeys((*settings.simulator_names, *settings.joiners), 'sim')
    return roles | {role: role for role in settings.roles if role != 'sim'}


def plan(seed: int) -> Plan:
    """Draw a run and its troubles."""
    rng = random.Random(f'plan {seed}')
    choices = all_settings()
    settings = choices[seed % len(choices)]
    names = list(names_of(settings))
    some = _Drawn(rng)
    partitions = tuple(_partition(rng, names) for _ in range(some.number(0.3)))
    weather = Weather(
        delay=rng.choice((0.001, 0.02, 0.3)),
        reorder=some.happens(0.5),
        doubled=some.share(0.4),
        lost=some.share(0.4),
        overrun=0.03 if some.happens(0.06) else 0.0,
        strangers=0.05 if some.happens(0.2) else 0.0,
        lies=0.1 if some.happens(0.2) else 0.0,
        partitions=partitions,
    )
    paces = {
        name: Pace(
            begins=rng.uniform(0, 30) if some.happens(0.1) else rng.uniform(0, 1),
            slice_seconds=rng.uniform(0.5, 2) if some.happens(0.1) else 0.02,
            stalls=[_stall(rng) for _ in range(some.number(0.1))],
        )
        for name in names
    }
    disk = Trouble()
    if some.happens(0.06):
        disk.room = rng.randint(0, 60_000)
    if some.happens(0.06):
        disk.syncs = rng.randint(0, 6)
    # drawn last: what a seed drew before stays as it was
    leave_out_after = rng.choice((0.0, 3.0, 12.0)) if settings.simulators > 1 else 0.0
    unanswered = rng.uniform(0.01, 0.1) if some.happens(0.3) else 0.0
    weather = replace(weather, unanswered=unanswered)
    deaths = _deaths(rng, names) if some.happens(0.3) else ()
    checkpoints = Trouble()
    if some.happens(0.05):
        checkpoints.room = rng.randint(0, 60_000)
    if some.happens(0.05):
        checkpoints.syncs = rng.randint(0, 12)
    for each, most in ((disk, 60), (checkpoints, 20)):
        if some.happens(0.15):
            each.kills_in, each.power = rng.randint(0, most), some.happens(0.5)
    made = Plan(seed, settings, weather, paces, disk, False, leave_out_after, deaths, checkpoints)
    heals = (
        disk.mends
        and checkpoints.mends
        and all(each.seconds <= LEASE for each in partitions)
        and made.silent < DEADLINE / 2
    )
    return replace(made, heals=heals)


class _Drawn:
    """Draws whether and how much."""

    def __init__(self, rng: random.Random) -> None:
        self._rng = rng

    def happens(self, probability: float) -> bool:
        """Whether something happens."""
        return self._rng.random() < probability

    def share(self, probability: float) -> float:
        """0, or with a probability a share up to a third."""
        return self._rng.uniform(0.01, 0.35) if self.happens(probability) else 0.0

    def number(self, probability: float) -> int:
        """How many: each more with a probability."""
        count = 0
        while count < 3 and self.happens(probability):
            count += 1
        return count


def _length(rng: random.Random) -> float:
    """Seconds of a partition or stall: often short, sometimes beyond every deadline."""
    least, most = rng.choice(((0.1, 2), (0.1, 2), (2, 15), (2, 15), (15, 50), (50, 200)))
    return rng.uniform(least, most)


def _partition(rng: random.Random, names: list[str]) -> Partition:
    apart = frozenset(rng.sample(names, rng.randint(1, len(names) - 1)))
    return Partition(rng.uniform(0, BUSY), _length(rng), apart)


def _deaths(rng: random.Random, names: list[str]) -> tuple[Death, ...]:
    """Up to three times, some nodes or one: several at once, and some twice in a row."""
    deaths = []
    for _ in range(rng.randint(1, 3)):
        at, power = rng.uniform(0.5, BUSY), rng.random() < 0.3
        for name in rng.sample(names, rng.choice((1, 1, rng.randint(1, len(names))))):
            deaths.append(Death(name, at, rng.uniform(0.5, 10), power))
    return tuple(deaths)


def _stall(rng: random.Random) -> tuple[float, float]:
    return rng.uniform(0, BUSY), _length(rng)
