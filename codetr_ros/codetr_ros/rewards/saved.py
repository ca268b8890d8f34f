"""Saved reward models, of a fit or a run: read, compared, and used elsewhere.

A model means what it was trained to mean only under the settings that shape it and its labels. It
is refused where these differ; the settings of its training may differ.
"""

import logging
from dataclasses import dataclass
from pathlib import Path

import torch

from codetr_ros.config import Settings, from_canonical
from codetr_ros.config.delays import LONGEST
from codetr_ros.rewards import registry
from codetr_ros.rewards.aggregate import Aggregate
from codetr_ros.rewards.base import RewardMethod, RewardModelError
from codetr_ros.rewards.sequence import SequenceMethod
from codetr_ros.runs import checkpoints
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs.checkpoints import CheckpointError
from codetr_ros.system.parsing import shortened

_log = logging.getLogger(__name__)

ROLE = 'reward'
"""The name under which reward models are saved."""
_SHARED = ('method', 'target_scale', 'reward_unit')
_OF_TRAINING = frozenset(
    [
        *('batch', 'learning_rate', 'weight_decay', 'dropout', 'warmup_gradient_steps'),
        *('schedule', 'total_gradient_steps', 'first_gradient_steps', 'gradient_steps'),
        *('initialisation', 'label_batch', 'state_loss_weight', 'loss', 'subsequences'),
        *('subsequence_steps', 'scores', 'steps', 'scale_scores', 'gradient_norm'),
        *('kernel', 'signal', 'length_scale', 'noise'),
    ]
)
"""Settings of a reward model on which neither its weights' shapes nor its labels depend."""


@dataclass(frozen=True)
class SavedModel:
    """A reward model as a checkpoint holds it."""

    path: Path
    tensors: dict[str, torch.Tensor]
    settings: Settings  # under which it was trained
    task: str
    sizes: tuple[int, int]  # of observations and actions

    @property
    def digest(self) -> str:
        """The `reward_model_sha256` of its tensors."""
        return checkpoints.digest(self.tensors)


def read(path: Path) -> SavedModel:
    """Read a reward model.

    Args:
        path: a checkpoint's folder, or that of a fit or a run, whose newest checkpoint is taken.

    Raises:
        CheckpointError: there is none, or it is damaged.
        SettingsError: its settings are those of another version.
    """
    newest = checkpoints.latest(path / run_folder.CHECKPOINTS, ROLE)
    chosen = newest or path
    if newest is None and not (path / checkpoints.DESCRIPTION).is_file():
        raise CheckpointError(
            f'{path} is no checkpoint (it has no {checkpoints.DESCRIPTION}), and no folder of a '
            f'fit or a run with {run_folder.CHECKPOINTS}/{ROLE}-... in it'
        )
    tensors, meta = checkpoints.load(chosen)
    for name in ('settings', 'task'):
        if name not in meta:
            raise CheckpointError(
                f'checkpoint {chosen} lacks {name!r}: it is not that of a reward model'
            )
        if not isinstance(meta[name], str):
            raise CheckpointError(
                f'checkpoint {chosen}: {name} = {shortened(repr(meta[name]))} must be a text: it '
                'is damaged'
            )
    horizon = meta.get('horizon', LONGEST)
    if type(horizon) is not int or horizon < 1:
        raise CheckpointError(
            f'checkpoint {chosen}: horizon = {shortened(repr(horizon))} must be a whole number of '
            'steps: it is damaged'
        )
    settings = from_canonical(meta['settings'], f'checkpoint {chosen}').within(horizon)
    sizes = checkpoints.sizes_of(meta, chosen)
    model = checkpoints.of_model(tensors)
    return SavedModel(chosen, model, settings, meta['task'], sizes)


def restore(
    saved: SavedModel, settings: Settings, observation_size: int, action_size: int
) -> RewardMethod:
    """Make a reward method that goes on where a saved one stopped.

    Args:
        saved: the saved one.
        settings: under which it goes on.
        observation_size: O of the steps that it is to label.
        action_size: A of the steps that it is to label.

    Raises:
        RewardModelError: it was trained for another size, method or shape, or has not been
            trained: names both values.
    """
    wrong = [
        f'{name} = {theirs!r}, here {ours!r}'
        for name, theirs, ours in (
            ('observation_size', saved.sizes[0], observation_size),
            ('action_size', saved.sizes[1], action_size),
            *_differing(saved.settings, settings),
        )
        if theirs != ours
    ]
    if wrong:
        raise RewardModelError(
            f'checkpoint {saved.path} has {"; ".join(wrong)}: it means something else there. Use '
            "the checkpoint's settings (its run's or fit's config.yaml), or fit another model"
        )
    method = registry.make(settings, observation_size, action_size)
    try:
        method.load_state(saved.tensors)
    except RewardModelError as error:
        raise RewardModelError(f'checkpoint {saved.path}: {error}') from None
    if method.target_scale < 0:
        raise RewardModelError(
            f'checkpoint {saved.path} is damaged although its sha256 is right: target_scale = '
            f'{method.target_scale:g} must not be negative'
        )
    if not method.target_scale:
        raise RewardModelError(
            f'checkpoint {saved.path} was saved before anything was scored: it has learnt nothing'
        )
    for name, theirs, ours in (
        ('task', saved.task, settings.task),
        ('composite', saved.settings.composite, settings.composite),
    ):
        if theirs != ours:
            _log.warning(
                'checkpoint %s is of %s %r, here it is %r: do they mean the same?',
                saved.path,
                name,
                theirs,
                ours,
            )
    return method


def _differing(theirs: Settings, ours: Settings) -> list[tuple[str, object, object]]:
    """Settings that shape a model and its labels, as the two sides have them."""
    if theirs.method != ours.method:
        return [('method', theirs.method, ours.method)]
    kind = registry.kind(ours)
    groups = {getattr(kind, 'group', ''), getattr(kind, 'base_group', ''), ours.method}
    mine, saved = ours.flat(), theirs.flat()
    names = [*_SHARED]
    for name in mine:
        group, _, last = name.rpartition('.')
        if group and group in groups and last not in _OF_TRAINING:
            names.append(name)
    differing: list[tuple[str, object, object]] = [(n, saved[n], mine[n]) for n in names]
    if issubclass(kind, (SequenceMethod, Aggregate)):
        differing.insert(len(_SHARED), ('delay', theirs.longest, ours.longest))
    return differing
