"""What is said about a run when it is over: `summary.json` and `metrics.csv`.

Both are made from the run's records and from the reports that its nodes leave.
"""

import csv
import io
import json
import math
import resource
import time
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from codetr_ros.config import Settings
from codetr_ros.records import TOPICS, Commit, EpisodeResult, Metrics, Record
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs.recovery import Recovery
from codetr_ros.system.files import atomic_write
from codetr_ros.system.versions import versions

Report = Mapping[str, Any]


_COUNTS = ('published', 'recorded', 'received_by_learner', 'received_by_reward')


_FAULTS = ('lost', 'duplicated', 'refused')


@dataclass
class _Results:
    """Episodes of an evaluation or of a phase's training: each once, however often told."""

    version: int
    told: dict[tuple[str, int], EpisodeResult] = field(default_factory=dict)

    def add(self, result: EpisodeResult) -> None:
        self.told[result.source, result.episode] = result

    @property
    def episodes(self) -> list[EpisodeResult]:
        """In an order that does not depend on who was heard first."""
        return [result for _, result in sorted(self.told.items())]

    def row(self, step: int) -> dict[str, Any]:
        episodes = self.episodes
        true = np.array([e.true_return for e in episodes])
        score = np.array([e.score for e in episodes])
        return {
            'step': step,
            'version': self.version,
            'true_return_mean': float(true.mean()),
            'true_return_std': float(true.std()),
            'true_return_min': float(true.min()),
            'true_return_max': float(true.max()),
            'composite_return_mean': float(np.mean([e.composite_return for e in episodes])),
            'score_mean': float(score.mean()),
            'score_std': float(score.std()),
            'length_mean': float(np.mean([e.length for e in episodes])),
            'episodes': len(episodes),
        }


class Summary:
    """Gathers what a run's nodes say and makes its summary.

    Args:
        settings: the run's settings.
        run_id: its name.
        in_process: whether it ran without topics.
        clock: seconds, never going back; the run's time begins now.
    """

    def __init__(
        self,
        settings: Settings,
        run_id: str,
        in_process: bool,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.settings = settings
        self.run_id = run_id
        self.in_process = in_process
        self._clock = clock
        self._began = clock()
        self._evaluations: dict[int, _Results] = {}  # by step
        self._random: _Results | None = None
        self._training: dict[int, _Results] = {}  # by phase
        self._metrics: dict[int, dict[tuple[str, str, str], float]] = defaultdict(dict)  # by phase
        self._phases = 0
        self._recovery = Recovery(settings, recorded=not in_process)
        self._wall: float | None = None  # seconds that the run took, once it is over

    def receive(self, record: Record) -> None:
        """Take note of a record of the run, of whatever kind.

        Episodes, metrics and commits may come more than once, true rewards and labels must not.

        Raises:
            RecoveryError: labels come whose steps' true rewards have not all come before.
        """
        self._recovery.receive(record)
        if isinstance(record, EpisodeResult):
            if record.purpose == 'training':
                # the last phase that a step belongs to: step 1000 of 1000-step phases ends phase 0
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

    def end(self) -> None:
        """The run is over: what is learnt about it from now on takes none of its time."""
        self._wall = self.wall_s

    def evaluations(self) -> list[dict[str, Any]]:
        """One row for each evaluation, in order of training steps."""
        return [results.row(step) for step, results in sorted(self._evaluations.items())]

    def random(self) -> dict[str, Any] | None:
        """How the uniformly random policy did, or None where it was not evaluated."""
        return self._random.row(0) if self._random else None

    def build(
        self,
        reports: Mapping[str, Report],
        bag: Path | None = None,
        interrupted: bool = False,
        failure: str | None = None,
    ) -> dict[str, Any]:
        """The content of `summary.json`.

        Args:
            reports: what the nodes said at their end, by `<role>-<name>`.
            bag: the folder with the run's bag, if there is one.
            interrupted: somebody ended the run before it had finished.
            failure: why the run failed, if it did.

        Returns:
            A JSON-able dict. What is not known is None; numbers are finite.
        """
        settings, wall = self.settings, self.wall_s
        evaluations, random = self.evaluations(), self.random()
        last = evaluations[-1] if evaluations else None
        messages = count_messages(reports)
        said = {
            'run_id': self.run_id,
            'task': settings.task,
            'composite': settings.composite,
            'delay': settings.delay,
            'method': settings.method,
            'seed': settings.seed,
            'overlap': settings.overlap,
            'in_process': self.in_process,
            'interrupted': interrupted,
            'failure': failure,
            'steps': self.steps,
            'steps_planned': settings.steps,
            'phases': self.phases,
            'phases_planned': settings.phases,
            'wall_s': round(wall, 3),
            'steps_per_s': round(self.steps / wall, 3) if wall > 0 else None,
            'evaluations': evaluations,
            'random': random,
            'reward_recovery': self._recovery.rows,
            'random_score': random['score_mean'] if random else None,
            'final_score': last['score_mean'] if last else None,
            'random_true_return': random['true_return_mean'] if random else None,
            'final_true_return': last['true_return_mean'] if last else None,
            'policy_sha256': _from_role(reports, 'learner', 'policy_sha256'),
            'reward_model_sha256': _from_role(reports, 'reward', 'reward_model_sha256'),
            'updates': _from_role(reports, 'learner', 'updates'),
            'gradient_steps': _from_role(reports, 'reward', 'gradient_steps'),
            'messages': messages,
            **{fault: sum(row[fault] for row in messages.values()) for fault in _FAULTS},
            'bag': _from_role(reports, 'record', 'bag') or (str(bag) if bag else None),
            'processes': processes(reports),
            'counters': {
                n: r['counters'] for n, r in sorted(reports.items()) if r.get('counters')
            },
            'versions': versions(),
            'settings_hash': settings.hash(),
            'settings': settings.model_dump(mode='json'),
        }
        return {key: finite(value) for key, value in said.items()}

    def metrics_csv(self) -> str:
        """The content of `metrics.csv`: a row for each phase, a column for each number.

        Columns are `step`, `phase`, `<role>.<metric>` (or `<node>.<metric>` where a role has
        several nodes), the means of the training episodes that ended in the phase, and the
        evaluation of the policy that the phase's training made. The first row, at step 0, is the
        random policy. A cell is empty where there is no number.
        """
        nodes: dict[str, set[str]] = defaultdict(set)
        for said in self._metrics.values():
            for role, node, _ in said:
                nodes[role].add(node)
        rows: dict[int, dict[str, float]] = defaultdict(dict)
        for phase, said in self._metrics.items():
            for (role, node, name), value in said.items():
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
        evaluated = [(r.version, r.row(step)) for step, r in self._evaluations.items()]
        if self._random:
            evaluated.append((-1, self._random.row(0)))
        for version, row in evaluated:
            rows[version] |= {
                f'evaluation.{n}': v for n, v in row.items() if n not in ('step', 'version')
            }
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


def count_messages(reports: Mapping[str, Report]) -> dict[str, dict[str, int]]:
    """How many messages each topic carried, and what became of them.

    Returns:
        For each topic: published (by all nodes), recorded (in the bag), received by the learner
            and by the reward
        node, and what any node counted as lost, duplicated or refused.
    """
    table = {topic: dict.fromkeys((*_COUNTS, *_FAULTS), 0) for topic in TOPICS.values()}

    def add(report: Report, key: str, column: str) -> None:
        for topic, count in (report.get(key) or {}).items():
            row = table.setdefault(topic, dict.fromkeys((*_COUNTS, *_FAULTS), 0))
            row[column] += int(count)

    for report in reports.values():
        add(report, 'published', 'published')
        if report.get('role') in ('learner', 'reward'):
            add(report, 'received', f'received_by_{report["role"]}')
        if report.get('role') == 'record':
            add(report, 'recorded', 'recorded')
        for fault in _FAULTS:
            add(report, fault, fault)
    return table


def processes(reports: Mapping[str, Report]) -> dict[str, dict[str, Any]]:
    """What each process took, this one too: memory at its peak [MB] and processor time [s]."""
    keys = ('role', 'peak_rss_mb', 'cpu_s', 'wall_s', 'finished', 'error', 'exit_code')
    found = {
        name: {key: report.get(key) for key in keys} for name, report in sorted(reports.items())
    }
    own = resource.getrusage(resource.RUSAGE_SELF)
    found['codetr'] = {
        'role': 'codetr',
        'peak_rss_mb': own.ru_maxrss / 1024,
        'cpu_s': own.ru_utime + own.ru_stime,
        'wall_s': None,
        'finished': None,
        'error': None,
        'exit_code': None,
    }
    return found


def finite(value: Any) -> Any:
    """The same value with None for each number that JSON cannot hold (NaN, infinities)."""
    if isinstance(value, Mapping):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write(folder: Path, summary: Mapping[str, Any], metrics_csv: str) -> None:
    """Write `summary.json` and `metrics.csv` into a run's folder."""
    atomic_write(folder / run_folder.METRICS, metrics_csv)
    text = json.dumps(summary, indent=2, allow_nan=False)
    atomic_write(folder / run_folder.SUMMARY, text + '\n')


def _from_role(reports: Mapping[str, Report], role: str, key: str) -> Any:
    found = [report.get(key) for report in reports.values() if report.get('role') == role]
    return next((value for value in found if value is not None), None)
