"""The content of a run's `summary.json`: a model with a description of every field."""

import json
from collections.abc import Sequence
from pathlib import Path

from pydantic import Field, JsonValue

from codetr_ros.runs import facts
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs.facts import Counts, Facts, Number
from codetr_ros.system.files import atomic_write

FAULTS = ('lost', 'duplicated', 'refused')


class Evaluation(Facts):
    """The results of a policy in the episodes of one evaluation."""

    step: int = Field(description='training steps that the policy has learnt from')
    version: int = Field(description='version of the policy; -1: random')
    true_return_mean: Number = Field(
        description="mean of the episodes' true returns, in the environment's own rewards"
    )
    true_return_std: Number = Field(description='their standard deviation')
    true_return_min: Number = Field(description='the lowest of them')
    true_return_max: Number = Field(description='the highest of them')
    composite_return_mean: Number = Field(
        description="mean of the episodes' composite returns: the sums of their composite rewards"
    )
    score_mean: Number = Field(
        description="mean of the episodes' scores: composite return over that of an agent that "
        "earns the task's largest reward at every step"
    )
    score_std: Number = Field(description='their standard deviation')
    length_mean: Number = Field(description='mean length of the episodes [steps]')
    episodes: int = Field(description='number of episodes')


class RewardRecovery(Facts):
    """The agreement of labels with the environment's own rewards at an evaluation."""

    step: int = Field(description='training steps that the policy has learnt from')
    pearson: Number = Field(
        description='correlation over all steps; null if one side does not vary'
    )
    within: Number = Field(
        description="correlation after subtracting each segment's mean from both sides"
    )
    spearman: Number = Field(description='rank correlation over all steps')
    steps: int = Field(description='number of labelled steps that were compared')
    true_mean: Number = Field(None, description="mean of the environment's own rewards")
    true_std: Number = Field(None, description='their standard deviation')
    inferred_mean: Number = Field(
        None,
        description="mean of the inferred rewards, in the environment's unit; null if the factor "
        'between the units is not known',
    )
    inferred_std: Number = Field(None, description='their standard deviation')


class Spent(Facts):
    """The processor time that a run in one process had taken at an evaluation."""

    step: int = Field(description='training steps that the policy has learnt from')
    cpu_s: float = Field(
        description='processor time of all its parts and of all evaluations until then, this one '
        'included; without the start of the process [s]'
    )


class MessageCounts(Facts):
    """The numbers of messages that a topic carried, and what became of them."""

    published: int = Field(description='by all nodes')
    recorded: int = Field(description='in the bag')
    received_by_learner: int = Field(description='that reached the learner')
    received_by_reward: int = Field(description='that reached the reward node')
    lost: int = Field(description='that never reached a node that reads the topic')
    duplicated: int = Field(description='that reached a node more than once')
    refused: int = Field(description='that a node refused')
    different: int = Field(
        0,
        description='that came again, from a node that was started again, and were others than '
        'before',
    )


class ScorerRow(Facts):
    """What was known at the end of somebody who scored, where others than the simulator did."""

    scores: int = Field(description='segments in the memory that had a score of it')
    preferences: int = Field(description='pairs of segments in the memory that it had compared')
    offset: float | None = Field(
        description='a score of it is offset + slope * worth, on the scale of the first scorer'
    )
    slope: float | None = Field(description='see offset')
    noise: float | None = Field(
        description='standard deviation of its scores about that; null with a single scorer'
    )
    agreement: float | None = Field(
        description="correlation with the mean of the others' scores of the same segments; null "
        'where they share too few'
    )


class GivenScores(Facts):
    """The scores of the segments that began in a phase, where others than the simulator scored."""

    phase: int = Field(description='the phase')
    scores: int = Field(description='how many there are')
    per_step: float = Field(description='their mean, each divided by the steps of its segment')
    random: bool = Field(description='whether the random policy acted in it')


class ProcessUse(Facts):
    """The resources that a process used, and how it ended; null if not known."""

    role: str | None = Field(description='role of its node; `codetr` is the command itself')
    peak_rss_mb: float | None = Field(description='most memory that it had at once [MB]')
    cpu_s: float | None = Field(description='processor time [s]')
    wall_s: float | None = Field(description='time from its start to its end [s]')
    finished: bool | None = Field(description='whether it did everything that the run asked of it')
    error: str | None = Field(description='why it gave up')
    exit_code: int | None = Field(description='exit code; -N: ended by signal N')
    restarts: int | None = Field(
        None, description='how often it was started again after it had been killed'
    )


class RunSummary(Facts):
    """The identity, course and results of a run: the content of `summary.json`."""

    run_id: str = Field(description='name of the run')
    began: str | None = Field(
        None, description='date and time of its start, ISO 8601 with the offset from UTC'
    )
    host: str | None = Field(None, description='name of the machine that started it')
    command: str | None = Field(
        None, description='the command that started it; null if nodes were started one by one'
    )
    task: str = Field(description='task that was simulated')
    task_module: str | None = Field(
        None,
        description='file of the module that registered the task, for a task `module:id`; null '
        'otherwise, and in the first summaries',
    )
    composite: str = Field(description="how a segment's rewards made its composite reward")
    delay: int | str = Field(
        description='length n of a segment [steps]; 10:50: drawn between these; episode: whole '
        'episodes'
    )
    method: str = Field(description='how step rewards were made from composite rewards')
    seed: int = Field(description='seed of everything random')
    overlap: bool = Field(description='whether simulation ran a phase ahead of learning')
    in_process: bool = Field(description='whether it ran in one process, without topics')
    interrupted: bool = Field(description='whether the user ended it before it had finished')
    failure: str | None = Field(description='why it failed; null if it did not')
    steps: int = Field(description='environment steps of the committed phases')
    steps_planned: int = Field(description='environment steps that were planned')
    phases: int = Field(description='phases that were committed')
    phases_planned: int = Field(description='phases that were planned')
    wall_s: float = Field(description='its duration, the start of its processes included [s]')
    steps_per_s: float | None = Field(description='environment steps per second of that time')
    evaluations: list[Evaluation] = Field(
        description='in the order of training steps; only those of which every episode is there'
    )
    evaluations_missing: int = Field(
        0,
        description='evaluations of the steps taken that lack an episode, that of the random '
        'policy among them: the evaluator was killed, or too slow',
    )
    random: Evaluation | None = Field(
        description='results of the uniformly random policy; null if it was not evaluated'
    )
    reward_recovery: list[RewardRecovery] = Field(
        [],
        description='a row for each evaluation with labels; the first summaries lack it',
    )
    spent: list[Spent] = Field(
        [],
        description='a row for each evaluation of a run that one process ran from its beginning; '
        'none otherwise, and in the first summaries',
    )
    label_unit: Number = Field(
        None,
        description="unit of the step rewards that the policy learns from, in the environment's; "
        'null if not known',
    )
    random_score: Number = Field(description='mean score of the random policy')
    final_score: Number = Field(description='mean score of the last evaluation')
    random_true_return: Number = Field(description='mean true return of the random policy')
    final_true_return: Number = Field(description='mean true return of the last evaluation')
    policy_sha256: str | None = Field(description="digest of the final policy's weights")
    reward_model_sha256: str | None = Field(description="digest of the reward model's weights")
    updates: int | None = Field(description='SAC updates taken')
    gradient_steps: int | None = Field(description='gradient steps of the reward model')
    messages: dict[str, MessageCounts] = Field(description='counts of messages, by topic')
    lost: int = Field(description='lost messages, all topics together')
    duplicated: int = Field(description='duplicated messages, all topics together')
    refused: int = Field(description='refused messages, all topics together')
    left_out: Counts = Field(
        {}, description='phases that each source was left out of, because nothing came from it'
    )
    different: int = Field(
        0,
        description='messages that came again and were others than before, all topics together: '
        'what published them is not deterministic',
    )
    scorers: dict[str, ScorerRow] = Field(
        {}, description='who scored, by name, where others than the simulator did'
    )
    scores_given: list[GivenScores] = Field(
        [], description='the scores by phase, where others than the simulator scored'
    )
    bag: str | None = Field(description="folder of the run's bag; null without one")
    processes: dict[str, ProcessUse] = Field(
        description='resources that each process used, by `<role>-<name>` of its node'
    )
    counters: dict[str, Counts] = Field(
        description='other counts of the nodes, by `<role>-<name>` of the node'
    )
    versions: dict[str, str | None] = Field(
        description='versions of the packages that decide the numbers; null if not installed'
    )
    settings_hash: str = Field(description="sha256 of the settings' canonical JSON")
    settings: dict[str, JsonValue] = Field(description='every setting of the run')

    @property
    def complete(self) -> bool:
        """Whether everything planned was done."""
        return self.steps == self.steps_planned and not self.interrupted and not self.failure

    def evaluated(self) -> Sequence[Evaluation]:
        """The random policy, if it was evaluated, and all evaluations after it."""
        return [*([self.random] if self.random else []), *self.evaluations]


def write(folder: Path, summary: RunSummary) -> None:
    """Write `summary.json` into a run's folder."""
    text = json.dumps(summary.model_dump(mode='json'), indent=2, allow_nan=False)
    atomic_write(folder / run_folder.SUMMARY, text + '\n')


def read(path: Path) -> RunSummary:
    """Read a `summary.json`, of this version of the program or of an earlier one.

    Raises:
        RunFolderError: it is damaged, or not the summary of a run.
    """
    return facts.read(
        RunSummary, path, 'summary', 'give the folder of a run that `codetr train` has made'
    )
