"""`codetr fit --schedule epochs`: gradient steps on whole bags, early stopping on held-out data.

The seed chooses the held-out stretches: episodes, or parts of very long ones. So no segment that
judges the model is a neighbour of one that taught it, apart from the cuts of long episodes. They
stay in memory for the whole fit, within their share of `memory_steps`; stretches that do not fit
into that share are learnt from instead.

The other stretches are held in the rest of `memory_steps`. If they do not fit, the seed deals them
out among parts that do, each an equal mix of all bags, early and late, and the bags are read once
for each part. The target scale and the moments of the observations are those of the first part.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import count

import numpy as np
import torch

from codetr_ros.bags.reader import Bag
from codetr_ros.config import Settings
from codetr_ros.offline.cutting import Stretch
from codetr_ros.offline.errors import FitError
from codetr_ros.offline.loading import Loaded, load
from codetr_ros.offline.settings import FitSettings
from codetr_ros.rewards import registry
from codetr_ros.rewards.base import Predictor, RewardMethod, RewardModelError
from codetr_ros.rewards.learned import Learned
from codetr_ros.seeding import generator, seed_torch

BATCH = 256
"""Segments in a forward pass over held-out data."""


@dataclass
class Plan:
    """The stretches to hold out and to learn from."""

    held_out: list[Stretch]
    learnt: list[Stretch]
    capacity: int  # steps of `learnt` that are held at a time

    @property
    def passes(self) -> int:
        """Parts into which `learnt` is divided."""
        return max(1, -(-sum(s.steps for s in self.learnt) // self.capacity))


@dataclass
class Check:
    """The losses at one look at the held-out data."""

    gradient_steps: int
    loss: float | None  # mean of the batches since the look before, in units of c
    held_out_loss: float  # in units of c


@dataclass
class Fitted:
    """The result of a fit."""

    method: RewardMethod  # with its best weights
    held_out: Loaded
    begun_at: int = 0  # gradient steps of the initial model
    curve: list[Check] = field(default_factory=list)
    best: Check | None = None
    kept: dict[str, torch.Tensor] | None = None  # the weights of the best look
    stopped: str = ''
    most_steps: int = 0  # held at any time
    reads: int = 0  # of the bags, without that of the index
    seconds: float = 0.0


def plan(stretches: Sequence[Stretch], settings: Settings, fit: FitSettings) -> Plan:
    """Choose the stretches to hold out.

    Raises:
        FitError: there are too few stretches, or one does not fit into the memory.
    """
    if len(stretches) < 2:
        raise FitError(
            f'there is {len(stretches)} episode with scores: one to learn from and one to judge '
            f'by are needed. Give more bags, or lower stretch_steps ({fit.stretch_steps}) to cut '
            'long episodes'
        )
    total = sum(s.steps for s in stretches)
    share = int(fit.validation * min(total, settings.memory_steps))
    order = generator(settings.seed, 'fit', 'split').permutation(len(stretches)).tolist()
    held: set[int] = set()
    steps = 0
    for i in order[:-1]:
        # always one, then as many as there is room for
        if not held or steps + stretches[i].steps <= share:
            held.add(i)
            steps += stretches[i].steps
    made = Plan(
        [s for i, s in enumerate(stretches) if i in held],
        [s for i, s in enumerate(stretches) if i not in held],
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
    """The stretches to hold at a time, without end, each with its turn through all of them: all
    stretches if they fit, else random parts.
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
    report: Callable[[Check], None] = lambda check: None,
    method: RewardMethod | None = None,
) -> Fitted:
    """Fit a reward method by a plan.

    Args:
        bags: all bags, in the order of the index.
        made: the plan.
        sizes: of observations and actions.
        settings: method, its settings, seed, delay, memory_steps, threads.
        how: the schedule.
        report: called with each look at the held-out data.
        method: the method to fit, such as a restored one; a new one if None.

    Returns:
        The best weights, also if training diverged or was interrupted (Ctrl-C) after them:
        `stopped` gives the reason.

    Raises:
        BagError: a bag cannot be read.
        FitError: a bag has changed since it was indexed.
        RewardModelError: training has diverged before anything was learnt.
    """
    torch.set_num_threads(settings.thread_count)
    began = time.perf_counter()
    method = method or registry.make(settings, *sizes)
    held_out = load(bags, made.held_out, sizes, settings.longest, true_rewards=True)
    fitted = Fitted(method, held_out, method.gradient_steps, reads=1)
    try:
        _fit(bags, made, sizes, settings, how, fitted, report)
    except (KeyboardInterrupt, RewardModelError) as error:
        if fitted.kept is None:
            raise
        cause = 'by Ctrl-C' if isinstance(error, KeyboardInterrupt) else str(error)
        fitted.stopped = f'before its time, {cause}'
    if fitted.kept is not None:
        method.load_state(fitted.kept)
    fitted.seconds = time.perf_counter() - began
    return fitted


def _fit(
    bags: Sequence[Bag],
    made: Plan,
    sizes: tuple[int, int],
    settings: Settings,
    how: FitSettings,
    fitted: Fitted,
    report: Callable[[Check], None],
) -> None:
    method = fitted.method
    for turn, part in parts(made, settings.seed):
        if turn and not isinstance(method, Learned):
            fitted.stopped = f'method {method.name} takes no gradient steps'
            break
        learnt = load(bags, part, sizes, settings.longest)
        fitted.reads += 1
        steps = learnt.memory.steps + fitted.held_out.memory.steps
        fitted.most_steps = max(fitted.most_steps, steps)
        method.prepare(learnt.memory)
        if isinstance(method, Learned):
            for check in _learn(method, learnt, fitted, settings, how, made.passes == 1):
                fitted.curve.append(check)
                if fitted.best is None or check.held_out_loss < fitted.best.held_out_loss:
                    fitted.best, fitted.kept = check, method.state()
                report(check)
        del learnt  # before the next part is loaded
        if fitted.stopped:
            break


def _learn(
    method: Learned,
    learnt: Loaded,
    fitted: Fitted,
    settings: Settings,
    how: FitSettings,
    alone: bool,
) -> Iterator[Check]:
    """Take gradient steps on one part; sets `stopped` where the fit must end."""
    losses: list[float] = []
    if not fitted.curve:
        yield Check(fitted.begun_at, None, held_out_loss(method, fitted.held_out))
    while True:
        step = method.gradient_steps
        seed_torch(settings.seed, 'fit', step)
        metrics = method.gradient_step(learnt.memory, generator(settings.seed, 'fit', step))
        losses.append(metrics['reward_loss'])
        taken = method.gradient_steps - fitted.begun_at
        done = taken >= how.gradient_steps
        if done or taken % how.check_every == 0:
            yield Check(
                method.gradient_steps,
                float(np.mean(losses)),
                held_out_loss(method, fitted.held_out),
            )
            losses.clear()
            assert fitted.best is not None
            since = method.gradient_steps - fitted.best.gradient_steps
            if done:
                fitted.stopped = f'after {how.gradient_steps} gradient steps, as many as allowed'
            elif since >= how.patience * how.check_every:
                fitted.stopped = (
                    f'early: the held-out loss has not fallen for {since} gradient steps'
                )
            if fitted.stopped:
                return
        if not alone and taken % how.part_steps == 0:
            return


def predictions(method: Predictor, loaded: Loaded) -> np.ndarray:
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
