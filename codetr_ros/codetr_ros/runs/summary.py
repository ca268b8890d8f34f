"""The files that describe a finished run: `summary.json` and `metrics.csv`.

Both are made from the run's records and from the reports of its nodes.
"""

import csv
import io
import platform
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import TypeVar

import numpy as np
from pydantic import JsonValue

from codetr_ros.config import Settings
from codetr_ros.records import Commit, EpisodeResult, Metrics, Record
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs import run_summary, scorers, segments
from codetr_ros.runs.leavers import Leavers
from codetr_ros.runs.recovery import Recovery
from codetr_ros.runs.reports import NodeReport
from codetr_ros.runs.run_summary import Evaluation, GivenScores, RewardRecovery, RunSummary
from codetr_ros.runs.segments import Segment
from codetr_ros.runs.spent import ProcessorTime
from codetr_ros.runs.tallies import count_messages, processes
from codetr_ros.system import modules
from codetr_ros.system.files import atomic_write
from codetr_ros.system.versions import versions

_T = TypeVar('_T')


@dataclass
class _Results:
    """Episodes of an evaluation or of a phase's training: each once, however often received."""

    version: int
    by_episode: dict[tuple[str, int], EpisodeResult] = field(default_factory=dict)

    def add(self, result: EpisodeResult) -> None:
        self.by_episode[result.source, result.episode] = result

    @property
    def episodes(self) -> list[EpisodeResult]:
        """The episodes, in an order that does not depend on that of arrival."""
        return [result for _, result in sorted(self.by_episode.items())]

    def numbers(self) -> dict[str, float]:
        """Means and spread; NaN if a number of an episode is NaN."""
        episodes = self.episodes
        true = np.array([e.true_return for e in episodes])
        score = np.array([e.score for e in episodes])
        return {
            'true_return_mean': float(true.mean()),
            'true_return_std': float(true.std()),
            'true_return_min': float(true.min()),
            'true_return_max': float(true.max()),
            'composite_return_mean': float(np.mean([e.composite_return for e in episodes])),
            'score_mean': float(score.mean()),
            'score_std': float(score.std()),
            'length_mean': float(np.mean([e.length for e in episodes])),
        }

    def row(self, step: int) -> Evaluation:
        return Evaluation.model_validate(
            {
                'step': step,
                'version': self.version,
                **self.numbers(),
                'episodes': len(self.by_episode),
            }
        )


class Summary:
    """Gathers the records of a run and makes its summary.

    Args:
        settings: the run's settings.
        run_id: its name.
        in_process: whether it ran without topics.
        clock: seconds, never going back; the time of the run begins now.
        command: the command that started it; None if nodes were started one by one.
        recorded: labels come from the run's bag, at least for a part of the run.
    """

    def __init__(
        self,
        settings: Settings,
        run_id: str,
        in_process: bool,
        clock: Callable[[], float] = time.monotonic,
        command: str | None = None,
        recorded: bool | None = None,
    ) -> None:
        self.settings = settings
        self.run_id = run_id
        self.in_process = in_process
        self.command = command
        self.start = datetime.now().astimezone()
        self._clock = clock
        self._began = clock()
        self._evaluations: dict[int, _Results] = {}  # by step
        self._random: _Results | None = None
        self._training: dict[int, _Results] = {}  # by phase
        self._metrics: dict[int, dict[tuple[str, str, str], float]] = defaultdict(dict)  # by phase
        self._phases = 0
        self._before = 0  # steps of the run before its time began
        self._recovery = Recovery(settings, not in_process if recorded is None else recorded)
        self._leavers = Leavers()
        self._processor = ProcessorTime() if in_process else None
        self.scores_given: list[GivenScores] = []  # from the bag
        self._wall: float | None = None  # seconds that the run took, once it is over

    def receive(self, record: Record) -> None:
        """Note a record of the run, of any kind.

        Episodes, metrics and commits may come more than once; true rewards and labels must not.

        Raises:
            RecoveryError: labels come before some of the true rewards of their steps.
        """
        self._recovery.receive(record)
        if self._processor is not None:
            self._processor.receive(record)
        if isinstance(record, EpisodeResult):
            if record.purpose == 'training':
                # step 1000 of 1000-step phases ends phase 0
                phase = max(0, record.step - 1) // self.settings.phase_steps
                self._training.setdefault(phase, _Results(record.version)).add(record)
            elif record.purpose == 'random':
                self._random = self._random or _Results(record.version)
                self._random.add(record)
            else:
                results = self._evaluations.setdefault(record.step, _Results(record.version))
                results.add(record)
        elif isinstance(record, Metrics):
            for name, value in zip(record.names, record.values.tolist(), strict=True):
                self._metrics[record.phase][record.role, record.node, name] = value
        elif isinstance(record, Commit):
            self._phases = max(self._phases, record.phase + 1)
            self._leavers.receive(record)

    @property
    def phases(self) -> int:
        """Phases that were committed."""
        return self._phases

    @property
    def steps(self) -> int:
        """Environment steps of the committed phases."""
        return self.settings.steps_after(self._phases - 1)

    @property
    def wall_s(self) -> float:
        """Seconds that the run has taken, the start of its processes included."""
        return self._clock() - self._began if self._wall is None else self._wall

    def go_on(self) -> None:
        """Note that all received so far is of an earlier time: the run goes on from here."""
        self._before = self.steps
        if self._processor is not None:
            self._processor.go_on()

    def end(self, wall_s: float | None = None) -> None:
        """End the time of the run; records may still come.

        Args:
            wall_s: seconds that it took; None: until now.
        """
        self._wall = self.wall_s if wall_s is None else wall_s

    def evaluations(self) -> list[Evaluation]:
        """A row for each evaluation that is whole, in order of training steps."""
        return [
            results.row(step)
            for step, results in sorted(self._evaluations.items())
            if self._whole(results)
        ]

    def random(self) -> Evaluation | None:
        """The row of the uniformly random policy; None if it was not evaluated, or in part."""
        return self._random.row(0) if self._random and self._whole(self._random) else None

    def _whole(self, results: _Results) -> bool:
        """Whether all episodes of an evaluation are there: of half of them the mean is another."""
        return len(results.by_episode) >= self.settings.evaluate_episodes

    def _evaluations_missing(self) -> int:
        """How many evaluations of the committed phases are not there, or not whole."""
        settings = self.settings
        if not settings.evaluate_every or not self._phases:
            return 0
        there = {row.version for row in self.evaluations()}
        due = [version for version in range(self._phases) if settings.evaluated(version)]
        return sum(version not in there for version in due) + (self.random() is None)

    @property
    def label_unit(self) -> float | None:
        """The unit of labels in that of the task, as the reward node reported it last; None if it
        did not.
        """
        units = [
            value
            for _, values in sorted(self._metrics.items())
            for (role, _, name), value in values.items()
            if (role, name) == ('reward', 'label_unit')
        ]
        return units[-1] if units and units[-1] > 0 else None

    def segments(self) -> list[Segment]:
        """Some segments with their inferred and true rewards, in the unit of the task; none if the
        unit of the labels is not known.
        """
        unit = self.label_unit
        if unit is None:
            return []
        return [
            replace(one, labels=one.labels * np.float32(unit)) for one in self._recovery.segments
        ]

    def _reward_recovery(self) -> list[RewardRecovery]:
        unit = self.label_unit
        rows = []
        for row in self._recovery.rows:
            inferred = {
                name: None if unit is None else row[name] * unit
                for name in ('inferred_mean', 'inferred_std')
            }
            rows.append(RewardRecovery.model_validate(row | inferred))
        return rows

    def build(
        self,
        reports: Mapping[str, NodeReport],
        bag: Path | None = None,
        interrupted: bool = False,
        failure: str | None = None,
    ) -> RunSummary:
        """The content of `summary.json`; unknown values are None.

        Args:
            reports: the nodes' reports, by `<role>-<name>`.
            bag: the folder of the run's bag, if there is one.
            interrupted: the user ended the run before it had finished.
            failure: why the run failed, if it did.
        """
        settings, wall = self.settings, self.wall_s
        evaluations, random = self.evaluations(), self.random()
        last = evaluations[-1] if evaluations else None
        messages = count_messages(reports)

        def of_role(role: str) -> list[NodeReport]:
            return [report for report in reports.values() if report.role == role]

        settings_json: dict[str, JsonValue] = settings.model_dump(mode='json')
        return RunSummary(
            run_id=self.run_id,
            began=self.start.isoformat(timespec='seconds'),
            host=platform.node(),
            command=self.command,
            task=settings.task,
            task_module=modules.file_of_task(settings.task),
            composite=settings.composite,
            delay=settings.delay,
            method=settings.method,
            seed=settings.seed,
            overlap=settings.overlap,
            in_process=self.in_process,
            interrupted=interrupted,
            failure=failure,
            steps=self.steps,
            steps_planned=settings.steps,
            phases=self.phases,
            phases_planned=settings.phases,
            wall_s=round(wall, 3),
            steps_per_s=round((self.steps - self._before) / wall, 3) if wall > 0 else None,
            evaluations=evaluations,
            evaluations_missing=self._evaluations_missing(),
            random=random,
            reward_recovery=self._reward_recovery(),
            spent=self._processor.rows() if self._processor is not None else [],
            label_unit=self.label_unit,
            random_score=random.score_mean if random else None,
            final_score=last.score_mean if last else None,
            random_true_return=random.true_return_mean if random else None,
            final_true_return=last.true_return_mean if last else None,
            policy_sha256=_first(r.policy_sha256 for r in of_role('learner')),
            reward_model_sha256=_first(r.reward_model_sha256 for r in of_role('reward')),
            updates=_first(r.updates for r in of_role('learner')),
            gradient_steps=_first(r.gradient_steps for r in of_role('reward')),
            messages=messages,
            lost=sum(row.lost for row in messages.values()),
            duplicated=sum(row.duplicated for row in messages.values()),
            refused=sum(row.refused for row in messages.values()),
            left_out=self._leavers.phases,
            different=sum(row.different for row in messages.values()),
            scorers=scorers.rows(
                (name, value)
                for _, values in sorted(self._metrics.items())
                for (role, _, name), value in values.items()
                if role == 'reward'
            ),
            scores_given=self.scores_given,
            # where it is now: the folder may have been moved since the recorder wrote it
            bag=str(bag) if bag else _first(r.bag for r in of_role('record')),
            processes=processes(reports),
            counters={n: r.counters for n, r in sorted(reports.items()) if r.counters},
            versions=modules.version_of_task(settings.task) | versions(),
            settings_hash=settings.hash(),
            settings=settings_json,
        )

    def metrics_csv(self) -> str:
        """The content of `metrics.csv`: a row for each phase, a column for each number.

        Columns are `step`, `phase`, `<role>.<metric>` (or `<node>.<metric>` if a role has several
        nodes), the means of the training episodes that ended in the phase, and the evaluation of
        the policy after the phase's training. The first row, at step 0, is the random policy. A
        cell without a number is empty.
        """
        nodes: dict[str, set[str]] = defaultdict(set)
        for values in self._metrics.values():
            for role, node, _ in values:
                nodes[role].add(node)
        rows: dict[int, dict[str, float]] = defaultdict(dict)
        for phase, values in self._metrics.items():
            for (role, node, name), value in values.items():
                place = role if len(nodes[role]) == 1 else node.rsplit('/', 1)[-1]
                rows[phase][f'{place}.{name}'] = value
        for phase, results in self._training.items():
            episodes = results.episodes
            rows[phase] |= {
                'training.true_return_mean': float(np.mean([e.true_return for e in episodes])),
                'training.score_mean': float(np.mean([e.score for e in episodes])),
                'training.length_mean': float(np.mean([e.length for e in episodes])),
                'training.episodes': len(episodes),
            }
        evaluated = [(results.version, results) for results in self._evaluations.values()]
        if self._random:
            evaluated.append((-1, self._random))
        for version, results in evaluated:
            if not self._whole(results):
                continue
            rows[version] |= {f'evaluation.{n}': v for n, v in results.numbers().items()}
            rows[version]['evaluation.episodes'] = len(results.episodes)
        columns = sorted({column for row in rows.values() for column in row})
        text = io.StringIO()
        writer = csv.writer(text, lineterminator='\n')
        writer.writerow(['step', 'phase', *columns])
        for phase, row in sorted(rows.items()):
            cells = [repr(row[c]) if c in row else '' for c in columns]
            writer.writerow(
                [self.settings.steps_after(phase), phase if phase >= 0 else '', *cells]
            )
        return text.getvalue()


def write(
    folder: Path, summary: RunSummary, metrics_csv: str, shown: Sequence[Segment] = ()
) -> None:
    """Write `summary.json`, `metrics.csv` and, if there are segments to show, `step_rewards.csv`
    into a run's folder.
    """
    atomic_write(folder / run_folder.METRICS, metrics_csv)
    if shown:
        atomic_write(folder / run_folder.STEP_REWARDS, segments.to_csv(shown))
    run_summary.write(folder, summary)


def _first(values: Iterable[_T | None]) -> _T | None:
    """The first known value."""
    return next((value for value in values if value is not None), None)
