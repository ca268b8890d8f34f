"""What becomes of the folder of a run before the run is gone on with: its bag is checked and cut
back, and checkpoints that fit it no more are removed.
"""

import logging
from collections.abc import Callable
from pathlib import Path

from codetr_ros.bags.cutting import Cut, announced, cut
from codetr_ros.bags.errors import BagError
from codetr_ros.bags.metadata import METADATA
from codetr_ros.bags.reader import Bag
from codetr_ros.bags.reopening import holds_messages, mend
from codetr_ros.config import Settings, from_canonical, settled
from codetr_ros.cores import going_on
from codetr_ros.records import Commit, RunSpec
from codetr_ros.runs import checkpoints
from codetr_ros.runs import folder as run_folder

_log = logging.getLogger(__name__)


def for_nodes(
    settings: Settings, run_id: str, folder: Path, log: Callable[[str], None] = _log.warning
) -> None:
    """Prepare the folder of a run over topics to be gone on with: its nodes then restore
    themselves.

    If the run gets longer, what its end has decided is cut off. The last policy, for example, has
    permitted nothing more, and is published anew. And the reward node goes on from no later phase
    than the learner: nobody else can make the labels between.

    Args:
        settings: the run's settings; only `steps` may be others than before, and more.
        run_id: its name.
        folder: its folder.
        log: takes what people should know, a line at a time.

    Raises:
        BagError: the bag is damaged before its last commit, of another run or of other settings.
        OSError: it cannot be written.
    """
    settings, bag = settled(settings), folder / run_folder.BAG
    check_not_lost(bag, folder)
    if holds_messages(bag):
        mend(bag)
    before = announced(bag)
    if before is None:
        begin_again(folder, log)
        return
    check(before, settings, run_id, bag)
    known = from_canonical(before.settings, str(bag))
    if known.steps != settings.steps:
        _lengthen(known, settings, folder, log)
    where, learnt = folder / run_folder.CHECKPOINTS, -1
    if not any(Bag(bag, lambda damage: None).entries({Commit})):
        forget_checkpoints(folder, log)
    else:
        learnt = next((c.phase for c in checkpoints.sound(where, 'learner', None, log)), -1)
    for path in checkpoints.remove_after(where, 'reward', learnt + 1):
        log(f'removed {path}: the learner goes on from phase {learnt}, and needs all labels since')


def _lengthen(
    known: Settings, settings: Settings, folder: Path, log: Callable[[str], None]
) -> None:
    """Cut off what the end of a shorter run has decided."""
    bag = folder / run_folder.BAG
    commit = cut_back(bag, known, settings, log).commit
    # all that was learnt up to there lies before the commit
    newest = -1 if commit is None else commit.phase - settings.lag
    if known.warmup_phases != settings.warmup_phases:
        newest = -1  # at the end of its warm-up the shorter run has learnt
    for role in ('reward', 'learner'):
        checkpoints.remove_after(folder / run_folder.CHECKPOINTS, role, newest)


def check_not_lost(bag: Path, folder: Path) -> None:
    """Refuse to begin anew where only the bag is gone: a phase is learnt from only once it is on
    the disk.

    Raises:
        BagError: there are checkpoints, and not one file of a bag.
    """
    where = folder / run_folder.CHECKPOINTS
    made = [path for role in ('learner', 'reward') for path in checkpoints.every(where, role)]
    if made and not holds_messages(bag):
        raise BagError(
            f'there is no bag {bag}, from which {made[-1]} was learnt: it was lost or moved. '
            'Restore it from a copy, or start the run again with another --out'
        )


def check(before: RunSpec, settings: Settings, run_id: str, bag: Path) -> None:
    """Refuse a bag of another run, or of other settings than `steps`."""
    if before.run_id != run_id:
        raise BagError(f'bag {bag} holds run {before.run_id!r}, not {run_id!r}')
    if changed := going_on.other_settings(before.settings, settings, str(bag)):
        raise BagError(
            f'bag {bag} is of a run with {changed}: a run goes on with the settings that it began '
            f'with, only {", ".join(going_on.MAY_CHANGE)} may change'
        )


def cut_back(
    bag: Path, before: Settings | None, settings: Settings, log: Callable[[str], None]
) -> Cut:
    """Cut the bag back to the last commit of a phase that has all its steps."""

    def announcement(spec: RunSpec) -> RunSpec:
        new = settings.run_spec(spec.run_id)
        return spec if new.settings == spec.settings else new

    newest = None
    if before is not None:
        last = before.phases - 1
        if before.steps_of(last) != settings.steps_of(last):
            newest = last - 1
            log(
                f'phase {last} had {before.steps_of(last)} of {settings.steps_of(last)} steps, '
                'as the last of a shorter run: it is done again'
            )
    made = cut(bag, announcement, newest)
    left_out = +made.left_out
    if made.commit is not None:
        gone = ', '.join(f'{n} of {topic}' for topic, n in sorted(left_out.items()))
        log(
            f'the bag ends with the commit of phase {made.commit.phase}'
            + (f'; what came behind it is made again: {gone}' if gone else '')
        )
    return made


def begin_again(folder: Path, log: Callable[[str], None]) -> None:
    """Remove bag and checkpoints of a run of which nothing has been learnt from."""
    bag = folder / run_folder.BAG
    for path in sorted(bag.iterdir()) if bag.is_dir() else ():
        if path.suffix == '.mcap' or path.name == METADATA:
            path.unlink()
    forget_checkpoints(folder, log)


def forget_checkpoints(folder: Path, log: Callable[[str], None]) -> None:
    """Remove the checkpoints of a run whose bag holds no committed phase."""
    log('no phase was committed: the run begins from its start')
    for role in ('learner', 'reward'):
        checkpoints.remove_after(folder / run_folder.CHECKPOINTS, role, -1)
