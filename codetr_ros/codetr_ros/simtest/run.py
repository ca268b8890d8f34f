"""One simulated run, and what must be true of it."""

import logging
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import cast

import torch

from codetr_ros.bags.definitions import decode
from codetr_ros.bags.errors import BagError
from codetr_ros.config import Settings
from codetr_ros.cores import in_process
from codetr_ros.cores.consumer import Consumer
from codetr_ros.cores.core import Core
from codetr_ros.cores.evaluator import Evaluator
from codetr_ros.cores.labeller import Labeller
from codetr_ros.cores.learner import Learner
from codetr_ros.cores.recorder import Recorder
from codetr_ros.cores.simulator import Simulator
from codetr_ros.nodes import errors
from codetr_ros.records import Commit, Record, RecordError, RunSpec
from codetr_ros.runs import checkpoints
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs.checkpoints import CheckpointError, every, latest
from codetr_ros.simtest import checks
from codetr_ros.simtest.disks import KilledError, Trouble, TroubledDisk
from codetr_ros.simtest.mail import Post
from codetr_ros.simtest.place import Pace, Place
from codetr_ros.simtest.plan import BACK, DEADLINE, Death, Plan, names_of, plan
from codetr_ros.simtest.process import Process
from codetr_ros.simtest.recording import Recording
from codetr_ros.simtest.replay import replayed
from codetr_ros.simtest.world import World

RUN_ID = 'simtest'


@dataclass(frozen=True)
class Outcome:
    """How a simulated run ended.

    Attributes:
        plan: what was planned.
        failures: what is wrong, in words; empty: everything that must be true is.
        errors: why nodes gave up, by name.
        seconds: the virtual time that it took [s].
        trace: the newest events.
    """

    plan: Plan
    failures: list[str]
    errors: dict[str, str]
    seconds: float
    trace: list[str]


@dataclass(frozen=True)
class Digests:
    """The weights that a run ended with."""

    policy: str | None
    reward_model: str | None


@cache
def undisturbed(canonical: str) -> Digests:
    """The weights of a run in which nothing happens, in process.

    Args:
        canonical: its settings, as `Settings.canonical` has them.
    """
    reports = in_process.run(Settings.model_validate_json(canonical), RUN_ID)
    reward = reports.get('reward')
    return Digests(
        reports['learner'].policy_sha256, reward.reward_model_sha256 if reward else None
    )


def core_of(
    role: str, name: str, run: RunSpec, settings: Settings, checkpoints: Path | None
) -> Core[Record]:
    """The core of a node.

    Args:
        role: one of `records.ROLES`.
        name: of the node.
        run: the run.
        settings: its settings.
        checkpoints: where they go; None: nowhere.
    """
    if role == 'sim':
        return Simulator(run, settings, name)
    if role == 'record':
        return Recorder(run, settings, name)
    if role == 'reward':
        return Labeller(run, settings, name, checkpoints)
    if role == 'learner':
        return Learner(run, settings, name, checkpoints)
    return Evaluator(run, settings, name)


class Simulated:
    """A run in a simulated world.

    Args:
        planned: what will happen.
        folder: an empty one, for the bag; checkpoints go beside it.
        kept: how many events the trace holds.
    """

    def __init__(self, planned: Plan, folder: Path, kept: int) -> None:
        self.plan = planned
        self.folder = folder
        self.world = World(planned.seed, kept)
        self.disk = TroubledDisk(replace(planned.disk))
        self.post = Post(self.world, planned.weather)
        self.failures: list[str] = []
        self._run = planned.settings.run_spec(RUN_ID)
        dying = {death.name for death in planned.deaths}
        keeps = dying & {'reward', 'learner'} or planned.checkpoints != Trouble()
        self._checkpoint_disk = TroubledDisk(replace(planned.checkpoints))
        self._torn: set[Path] = set()  # checkpoints that are damaged on purpose
        self._checkpoints = folder.parent / run_folder.CHECKPOINTS if keeps else None
        self._dead = 0  # processes that will be there again
        self._going: Process | None = None  # one that has not ended
        self.processes: dict[str, Process] = {}
        self.post.processes = self.processes
        self.post.watch = self._watch
        for name, role in names_of(planned.settings).items():
            self._start(role, name, planned.paces[name])
        for death in planned.deaths:
            self.world.at(death.at, partial(self._kill, death))

    def _start(self, role: str, name: str, pace: Pace, instance: int = 1) -> Process:
        settings = self.plan.settings
        place = Place(
            self.world, self.post, self._run, settings, role, name, pace, DEADLINE, instance
        )
        core = core_of(role, name, self._run, settings, self._checkpoints)
        if isinstance(core, Consumer):
            core.disk = self._checkpoint_disk
        made = self.processes[name] = (
            Recording(place, core, self.folder, self.disk, self.plan.leave_out_after)
            if role == 'record'
            else Process(place, core)
        )
        made.when_killed = self._killed_within
        if isinstance(made, Recording):
            try:
                made.open()
            except KilledError:
                made.die()
                self._killed_within(made)
            except (BagError, RecordError) as error:
                # a full disk, or a bag that contradicts itself
                made.error = error
                made.end()
        return made

    def _kill(self, death: Death) -> None:
        killed = self.processes[death.name]
        if killed.ended or killed.over:
            return
        killed.die()
        if death.power:
            self._lose_power(killed)
        self._come_back(killed, death.seconds)

    def _come_back(self, killed: Process, seconds: float) -> None:
        self._dead += 1
        self.world.at(self.world.now + seconds, partial(self._start_again, killed))

    def _killed_within(self, killed: Process) -> None:
        """A process was killed within a call of its disk."""
        disk = self.disk if isinstance(killed, Recording) else self._checkpoint_disk
        disk.abandon()
        if disk.trouble.power:
            disk.lose_power(self.world.rng)
            self._check_checkpoints()
        self._come_back(killed, BACK)

    def _check_checkpoints(self) -> None:
        """A checkpoint that has its name outlasts a loss of power."""
        if self._checkpoints is None or not self._checkpoints.is_dir():
            return
        there = [p for role in ('reward', 'learner') for p in every(self._checkpoints, role)]
        for path in set(there) - self._torn:
            try:
                checkpoints.load(path)
            except CheckpointError as error:
                self.failures.append(f'a loss of power has damaged a checkpoint: {error}')

    def _lose_power(self, killed: Process) -> None:
        """Lose what a node has not synced; or have its newest checkpoint torn, which is worse."""
        rng = self.world.rng
        if isinstance(killed, Recording):
            self.disk.lose_power(rng)
        elif self._checkpoints is not None and killed.role in ('reward', 'learner'):
            newest = latest(self._checkpoints, killed.role)
            if newest is not None:
                file = rng.choice(sorted(newest.iterdir()))
                os.truncate(file, rng.randint(0, file.stat().st_size - 1))
                self._torn.add(newest)
                self.world.note(killed.name, f'finds {newest.name} torn')

    def _start_again(self, killed: Process) -> None:
        """Start a node that was killed: it goes on where the run stands."""
        self._dead -= 1
        if self.recording.ended and not isinstance(killed, Recording) and not self._dead:
            return
        self.world.note(killed.name, 'is started again')
        pace = replace(self.plan.paces[killed.name], begins=self.world.now)
        made = self._start(killed.role, killed.name, pace, killed.place.instance + 1)
        self.post.deliver_lasting(made)

    @property
    def recording(self) -> Recording:
        """The recorder."""
        recording = self.processes['record']
        assert isinstance(recording, Recording)
        return recording

    def dropped(self) -> list[str]:
        """The sources that were left out, once for each phase."""
        commits = (raw for kind, raw in self.recording.bag.history if kind is Commit)
        there = (cast(Commit, decode(Commit, raw)) for raw in commits)
        return [source for each in there for source in each.dropped]

    def expected(self) -> Digests:
        """The weights that the run must end with: those of the undisturbed one or, where sources
        were left out, those that learn again from what was recorded.
        """
        settings = self.plan.settings
        if not self.dropped():
            return undisturbed(settings.canonical())
        there = [decode(kind, raw) for kind, raw in self.recording.bag.history]
        return Digests(*replayed(settings.run_spec(RUN_ID), settings, there))

    def _watch(self, kind: type, raw: bytes, reader: Process) -> None:
        """Look at what arrives at a consumer."""
        if found := checks.early_commit(kind, raw, reader, self):
            self.failures.append(found)

    def run(self) -> Outcome:
        """Let it happen, and judge it."""
        over = self.world.run(
            self.plan.longest,
            lambda: bool(self.failures) or (not self._dead and self._all_ended()),
        )
        processes = self.processes.values()
        if not over:
            waiting = [f'{p.name} {p.doing}' for p in processes if not p.ended]
            self.failures.append(
                f'stuck at {self.world.now:.0f} s: nobody ends the wait: {"; ".join(waiting)}'
            )
        if over and not self.failures:
            self.failures += checks.at_the_end(self)
        gave_up = {
            p.name: self._named(errors.in_words(p.error)) for p in processes if p.error is not None
        }
        failures = [self._named(text) for text in self.failures]
        trace = [self._named(text) for text in self.world.trace()]
        return Outcome(self.plan, failures, gave_up, self.world.now, trace)

    def _all_ended(self) -> bool:
        if self._going is None or self._going.ended:  # asked for after every event
            self._going = next((p for p in self.processes.values() if not p.ended), None)
        return self._going is None

    def _named(self, text: str) -> str:
        """A text without the name of the folder, which differs from run to run."""
        return text.replace(f'{self.folder.parent}/', '')


@contextmanager
def _quiet() -> Iterator[None]:
    """Without what the library logs: refusals are planned here."""
    before = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        yield
    finally:
        logging.disable(before)


def simulate(seed: int, kept: int = 400) -> Outcome:
    """Simulate the run of a seed, and judge it.

    Args:
        seed: from which the run and all its troubles are drawn.
        kept: how many of the newest events the trace holds.
    """
    return carry_out(plan(seed), kept)


def carry_out(planned: Plan, kept: int = 400) -> Outcome:
    """Simulate a run as it is planned, and judge it.

    Args:
        planned: what will happen.
        kept: how many of the newest events the trace holds.
    """
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory(prefix='codetr_simtest_', dir=_memory()) as folder, _quiet():
        return Simulated(planned, Path(folder) / run_folder.BAG, kept).run()


def _memory() -> str | None:
    """A folder in memory, where the machine has one."""
    return '/dev/shm' if Path('/dev/shm').is_dir() else None
