"""`codetr evaluate`: measure the policy of a run's newest checkpoint."""

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.table import Table

from codetr_ros.cli import FAILED, refuse, video
from codetr_ros.cli.terminal import console, parse_arguments
from codetr_ros.config import Settings, SettingsError
from codetr_ros.processes.openmp import threading_environment
from codetr_ros.records import EpisodeResult, Policy, RecordError
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs.folder import RunFolderError
from codetr_ros.runs.numbers import number


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Evaluate the policy of a run's newest checkpoint, without noise, and print a table.

    With the run's own seed (the default) the episodes begin where those of its evaluations began.
    """

    run_dir: Annotated[
        str, tyro.conf.Positional, tyro.conf.arg(metavar='RUN_DIR', help="the run's folder")
    ]
    episodes: Annotated[
        int | None,
        tyro.conf.arg(metavar='N', help='number of episodes; by default as in the run'),
    ] = None
    seed: Annotated[
        int | None, tyro.conf.arg(metavar='K', help="seed of start states; by default the run's")
    ] = None
    video: Annotated[
        str | None,
        tyro.conf.arg(
            metavar='FILE.mp4',
            help='also draw the episodes, from the first on until half a minute is full',
        ),
    ] = None


def main(arguments: Sequence[str]) -> int:
    """Evaluate and print; returns the exit code."""
    given = parse_arguments(Arguments, prog='codetr evaluate', arguments=arguments)
    folder = Path(given.run_dir)
    try:
        changes: dict[str, int] = {}
        if given.episodes is not None:
            changes['evaluate_episodes'] = given.episodes
        if given.seed is not None:
            changes['seed'] = given.seed
        settings = settings_to_read(folder).changed(changes, 'command line')
        if given.video is not None:
            video.check(Path(given.video))
    except (RunFolderError, SettingsError, video.VideoError) as error:
        return refuse(str(error))
    os.environ.update(threading_environment(settings))

    from codetr_ros.learners.base import LearnerError
    from codetr_ros.runs.checkpoints import CheckpointError
    from codetr_ros.simulation.composite import CompositeError
    from codetr_ros.simulation.tasks import TaskError

    try:
        policy = newest_policy(folder, settings)
        results = evaluate(policy, settings)
    except (
        RunFolderError,
        CheckpointError,
        LearnerError,
        TaskError,
        SettingsError,
        RecordError,
        CompositeError,
    ) as error:
        return refuse(str(error))
    shown = console(tables=True)
    shown.print(
        f'{settings.task}: policy after {settings.steps_after(policy.version)} steps, '
        f'{len(results)} episodes, seed {settings.seed}',
    )
    shown.print(table(results))
    if given.video is None:
        return 0
    try:
        shown.print(video.make(folder, Path(given.video), settings))
    except video.VideoError as error:
        console(stderr=True).print(f'codetr: {error}')
        return FAILED
    return 0


def settings_to_read(folder: Path) -> Settings:
    """The settings of the run in this folder, changed so that its policy can be read and evaluated
    here.

    Raises:
        RunFolderError: this is not the folder of a run, or of one on a robot.
        SettingsError: its settings are refused.
    """
    settings = settings_here(folder)
    if settings.on_robot:
        raise RunFolderError(
            f'{folder} has a run on a robot, {settings.task}, which nothing simulates: '
            f'`codetr export {folder}` writes its policy into a file, to act by on the robot'
        )
    return settings.changed({'evaluate_every': 1}, str(folder))


def settings_here(folder: Path) -> Settings:
    """The settings of the run in this folder, changed so that its policy can be read here: that
    needs neither the GPU that it was learnt on nor a compiler.

    Raises:
        RunFolderError: this is not the folder of a run.
        SettingsError: its settings are refused.
    """
    changes = {'device': 'cpu', 'sac.compile': False}
    return run_folder.read_settings(folder).changed(changes, str(folder))


def newest_policy(folder: Path, settings: Settings, place: Path | None = None) -> Policy:
    """The policy of the learner's newest checkpoint, as the learner would publish it.

    Args:
        folder: of the run.
        settings: of the run.
        place: the folder of the checkpoints; None: that of the run.

    Raises:
        RunFolderError: there is no checkpoint, or none with a policy that has learnt.
        CheckpointError: the checkpoint is damaged.
        LearnerError: its settings differ from those in the run's folder.
    """
    from codetr_ros.learners import registry
    from codetr_ros.learners.base import LearnerError
    from codetr_ros.policy.actor import weights_bytes
    from codetr_ros.runs import checkpoints

    place = place or folder / run_folder.CHECKPOINTS
    path = checkpoints.latest(place, 'learner')
    if path is None:
        raise RunFolderError(
            f'{place} holds no checkpoint of the learner: let the run get past its warm-up '
            f'({settings.warmup_steps} steps). A fit has a reward model, and no policy'
        )
    tensors, meta = checkpoints.load(path)
    phase = checkpoints.phase_of(path)
    if phase < settings.warmup_phases - 1:
        raise RunFolderError(
            f'{path} is from the warm-up ({settings.warmup_steps} steps): '
            'its policy has learnt nothing yet'
        )
    sizes = checkpoints.sizes_of(meta, path)
    state = checkpoints.of_model(tensors)
    if sum(sizes) > sum(tensor.numel() for tensor in state.values()):
        raise checkpoints.CheckpointError(
            f'checkpoint {path}: observation_size = {sizes[0]} and action_size = {sizes[1]} are '
            'more than its tensors have numbers: it is damaged'
        )
    learner = registry.make(settings, *sizes)
    try:
        learner.load_state(state)
    except LearnerError as error:
        raise LearnerError(f'checkpoint {path}: {error}') from None
    return Policy(
        run_id=str(meta.get('run_id', 'evaluate')),
        phase=phase + settings.lag,
        version=phase,
        sources=(),
        steps=np.zeros(0, np.uint32),
        random=False,
        network=learner.network,
        weights=weights_bytes(learner.actor),
    )


def evaluate(policy: Policy, settings: Settings) -> list[EpisodeResult]:
    """Run `settings.evaluate_episodes` episodes of this policy, without noise."""
    import torch

    from codetr_ros.cores.evaluator import Evaluator

    torch.set_num_threads(settings.thread_count)
    evaluator = Evaluator(settings.run_spec(policy.run_id), settings, 'evaluate')
    evaluator.receive(policy)
    results: list[EpisodeResult] = []
    try:
        for records in evaluator.work():
            if records is None:
                break
            results += [record for record in records if isinstance(record, EpisodeResult)]
    finally:
        evaluator.close()
    return results


def table(results: Sequence[EpisodeResult]) -> Table:
    """Mean and spread of the returns, scores and lengths of episodes."""
    shown = Table(box=None, pad_edge=False)
    shown.add_column('')
    for name in ('mean', 'std', 'min', 'max'):
        shown.add_column(name, justify='right')
    rows = (
        ('true return', [r.true_return for r in results]),
        ('composite return', [r.composite_return for r in results]),
        ('score', [r.score for r in results]),
        ('length', [r.length for r in results]),
    )
    for name, values in rows:
        array = np.array(values)
        spread = (array.mean(), array.std(), array.min(), array.max())
        shown.add_row(name, *(number(float(value), 6) for value in spread))
    return shown
