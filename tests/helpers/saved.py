"""Reward models that a run has trained and saved."""

from codetr_ros.cores.labeller import Labeller
from codetr_ros.records import StepRewards
from helpers.builders import run, task_spec, tiny
from helpers.cores import Endless, slices


def trained(folder, **changes):
    """A run of three phases that has left a checkpoint; its core."""
    return served(None, folder, **changes)


def served(checkpoint, folder=None, phases=3, frozen=False, spec=None, **changes):
    """A run of some phases whose reward side starts from a checkpoint; its core, its labels."""
    settings = tiny(**changes)
    path = str(checkpoint) if checkpoint else ''
    core = Labeller(run(settings), settings, 'reward', folder, path, frozen)
    core.receive(spec or task_spec())
    episode, work = Endless(settings), core.work()
    said = slices(work)
    for phase in range(phases):
        episode.phase(core, phase)
        said.append([r for r in slices(work) if isinstance(r, StepRewards)])
    return core, said
