"""`codetr fit --schedule epochs`: gradient steps on whole bags, early stopping on held-out data.

What is held out is chosen by seed, in stretches (an episode, or a part of a very long one), so
that no segment that judges the model is a neighbour of one that taught it, apart from the cuts of
long episodes. It is kept in memory for the whole fit, within its share of `memory_steps`; what
does not fit into that share is learnt from instead.

What is learnt from is held in the rest of `memory_steps`. Where it does not fit, the stretches are
dealt out by seed among parts that do, each an equal mix of all bags, early and late, and the bags
are read once for each part. The target scale and the moments of the observations are those of the
first part.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import count

import numpy as np
import torch

from codetr_ros.bags.reader import Bag
from codetr_ros.config import Settings
from codetr_ros.offline.episodes import Stretch
from codetr_ros.offline.errors import FitError
from codetr_ros.offline.loading import Loaded, load
from codetr_ros.offline.settings import FitSettings
from codetr_ros.rewards import registry
from codetr_ros.rewards.base import RewardMethod, RewardModelError
from codetr_ros.rewards.learned import Learned
from codetr_ros.seeding import generator, seed_torch

BATCH = 256
"""Segments in a forward pass over held-out data."""


@dataclass
class Plan:
    """What is held out, and what is learnt from at a time."""

    held_out: list[Stretch]
    learnt: list[Stretch]
    capacity: int  # steps of `learnt` that are held at a time

    @property
    def passes(self) -> int:
        """Parts into which what is learnt from is divided."""
        return max(1, -(-sum(s.steps for s in self.learnt) // self.capacity))


@dataclass
class Check:
    """A look at the held-out data."""

    gradient_steps: int
    loss: float | None  # mean of the batches since the look before, in units of c
    held_out_loss: float  # in units of c


@dataclass
class Fitted:
    """What came out of a fit."""

    method: RewardMethod  # with its best weights
    held_out: Loaded
    begun_at: int = 0  # gradient steps of the model that it began with
    curve: list[Check] = field(default_factory=list)
    best: Check | None = None
    kept: dict[str, torch.Tensor] | None = None  # the weights of the best look
    stopped: str = ''
    most_steps: int = 0  # held at any time
    reads: int = 0  # times that the bags were read, the index not counted
    seconds: float = 0.0


def plan(found: Sequence[Stretch], settings: Settings, fit: FitSettings) -> Plan:
    """Choose what is held out.

    Raises:
        FitError: there are too few stretches, or one does not fit into the memory.
    """
    if len(found) < 2:
        raise FitError(
            f'there is {len(found)} episode with scores: one to learn from and one to be judged '
            'by are the least. Give more bags, or lower stretch_steps '
            f'({fit.stretch_steps}) to cut long episodes'
        )
    total = sum(s.steps for s in found)
    share = int(fit.validation * min(total, settings.memory_steps))
    order = generator(settings.seed, 'fit', 'split').permutation(len(found)).tolist()
    held: set[int] = set()
    steps = 0
    for i in order[:-1]:
        # one in any case, and then as many as there is room for
        if not held or steps + found[i].steps <= share:
            held.add(i)
            steps += found[i].steps
    made = Plan(
        [s for i, s in enumerate(found) if i in held],
        [s for i, s in enumerate(found) if i not in held],
        settings.memory_steps - steps,
    )
    longest = max(s.steps for s in made.learnt)
    if longest > made.capacity:
        raise FitError(
            f'an episode of {longest} steps does not fit into memory_steps = '
            f'{settings.memory_steps}, of which {steps} are held out: raise memory_steps, or '
            f'lower stretch_steps ({fit.stretch_steps})'
        )
    return made


def parts(made: Plan, seed: int) -> Iterator[tuple[int, list[Stretch]]]:
    """What is held at a time, for ever, and in which turn through all of it: all of it again and
    again, or random parts.
    """
    for turn in count():
        order = generator(seed, 'fit', 'part', turn).permutation(len(made.learnt)).tolist()
        part: list[Stretch] = []
        steps = 0
        for i in order:
            stretch = made.learnt[i]
            if steps + stretch.steps > made.capacity:
                yield turn, part
                part, steps = [], 0
            part.append(stretch)
            steps += stretch.steps
        yield turn, part


def fit(
    bags: Sequence[Bag],
    made: Plan,
    sizes: tuple[int, int],
    settings: Settings,
    how: FitSettings,
    say: Callable[[Check], None] = lambda check: None,
    method: RewardMethod | None = None,
) -> Fitted:
    """Fit a reward method to what the plan says.

    Args:
        bags: all bags, in the order of the index.
        made: what is held out, what is learnt from.
        sizes: of observations and actions.
        settings: method, its settings, seed, delay, memory_steps, threads.
        how: the schedule.
        say: is told of each look at the held-out data.
        method: what is fitted, such as a restored one; a new one if None.

    Returns:
        The best weights that were found, also where training diverged or was interrupted
        (Ctrl-C) after them: `stopped` says so.

    Raises:
        BagError: a bag cannot be read.
        FitError: a bag has changed meanwhile.
        RewardModelError: training has diverged before anything was learnt.
    """
    torch.set_num_threads(settings.threads)
    began = time.perf_counter()
    method = method or registry.make(settings, *sizes)
    held_out = load(bags, made.held_out, sizes, settings.delay, true_rewards=True)
    found = Fitted(method, held_out, method.gradient_steps, reads=1)
    try:
        _fit(bags, made, sizes, settings, how, found, say)
    except (KeyboardInterrupt, RewardModelError) as error:
        if found.kept is None:
            raise
        words = 'by Ctrl-C' if isinstance(error, KeyboardInterrupt) else str(error)
        found.stopped = f'before its time, {words}'
    if found.kept is not None:
        method.load_state(found.kept)
    found.seconds = time.perf_counter() - began
    return found


def _fit(
    bags: Sequence[Bag],
    made: Plan,
    sizes: tuple[int, int],
    settings: Settings,
    how: FitSettings,
    found: Fitted,
    say: Callable[[Check], None],
) -> None:
    method = found.method
    for turn, part in parts(made, settings.seed):
        if turn and not isinstance(method, Learned):
            found.stopped = f'method {method.name} takes no gradient steps'
            break
        learnt = load(bags, part, sizes, settings.delay)
        found.reads += 1
        steps = learnt.memory.steps + found.held_out.memory.steps
        found.most_steps = max(found.most_steps, steps)
        method.prepare(learnt.memory)
        if isinstance(method, Learned):
            for check in _learn(method, learnt, found, settings, how, made.passes == 1):
                found.curve.append(check)
                if found.best is None or check.held_out_loss < found.best.held_out_loss:
                    found.best, found.kept = check, method.state()
                say(check)
        del learnt  # before the next part takes its memory
        if found.stopped:
            break


def _learn(
    method: Learned,
    learnt: Loaded,
    found: Fitted,
    settings: Settings,
    how: FitSettings,
    alone: bool,
) -> Iterator[Check]:
    """Gradient steps on one part; sets `stopped` where the fit is to end."""
    losses: list[float] = []
    if not found.curve:
        yield Check(found.begun_at, None, held_out_loss(method, found.held_out))
    while True:
        step = method.gradient_steps
        seed_torch(settings.seed, 'fit', step)
        said = method.gradient_step(learnt.memory, generator(settings.seed, 'fit', step))
        losses.append(said['reward_loss'])
        taken = method.gradient_steps - found.begun_at
        done = taken >= how.gradient_steps
        if done or taken % how.check_every == 0:
            yield Check(
                method.gradient_steps,
                float(np.mean(losses)),
                held_out_loss(method, found.held_out),
            )
            losses.clear()
            assert found.best is not None
            since = method.gradient_steps - found.best.gradient_steps
            if done:
                found.stopped = f'after {how.gradient_steps} gradient steps, as many as allowed'
            elif since >= how.patience * how.check_every:
                found.stopped = (
                    f'early: the held-out loss has not fallen for {since} gradient steps'
                )
            if found.stopped:
                return
        if not alone and taken % how.part_steps == 0:
            return


def predictions(method: Learned, loaded: Loaded) -> np.ndarray:
    """Predicted composite rewards of all segments of a memory, in the task's unit."""
    ids = loaded.memory.segments.ids()
    made = [
        method.predict(loaded.memory.segments.batch(ids[i : i + BATCH], method.context))
        for i in range(0, len(ids), BATCH)
    ]
    return np.concatenate(made)


def held_out_loss(method: Learned, loaded: Loaded) -> float:
    """Mean squared error of predicted composite rewards, in units of c squared.

    Raises:
        RewardModelError: it is not finite: training has diverged.
    """
    true = loaded.memory.segments.scores(loaded.memory.segments.ids())
    error = (predictions(method, loaded) - true) / method.target_scale
    loss = float(np.mean(error**2))
    if not np.isfinite(loss):
        raise RewardModelError(
            f'the held-out loss is {loss} after {method.gradient_steps} gradient steps: training '
            f'has diverged. Lower {method.group}.learning_rate'
        )
    return loss
