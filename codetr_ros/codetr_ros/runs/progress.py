"""Live progress of a run: a display that changes in place on a terminal, else plain lines.

It takes the run's records, from topics or in process, and knows nothing of ROS.
"""

import time
from collections import deque
from collections.abc import Callable
from typing import TextIO

import numpy as np
from rich.console import RenderableType
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from codetr_ros.config import Settings
from codetr_ros.records import Commit, EpisodeResult, Metrics, Presence, Record
from codetr_ros.runs import references
from codetr_ros.runs.display import Display
from codetr_ros.runs.leavers import Leavers
from codetr_ros.runs.numbers import exact, returns

_RATE_WINDOW = 5  # phases over which the present speed is measured


def duration(seconds: float) -> str:
    """Seconds for people: 42 s, 3:05 min, 2:10 h."""
    whole = round(seconds)
    if whole < 60:
        return f'{whole} s'
    if whole < 3600:
        return f'{whole // 60}:{whole % 60:02d} min'
    return f'{whole // 3600}:{whole % 3600 // 60:02d} h'


class Progress(Display):
    """Shows the progress of a run.

    Args:
        settings: the run's settings.
        stream: where to show it.
        live: change the display in place; None: if `stream` is a terminal.
        clock: seconds, never going back.
    """

    plain_every = 5.0
    live_every = 0.25

    def __init__(
        self,
        settings: Settings,
        stream: TextIO | None = None,
        live: bool | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._settings = settings
        super().__init__(stream, live, clock)
        self._phase = 0
        self._marks: deque[tuple[float, int]] = deque([(self._began, 0)], maxlen=_RATE_WINDOW + 1)
        self._metrics: dict[str, float] = {}
        self._random: list[EpisodeResult] = []
        self._evaluation: list[EpisodeResult] = []
        self._missed: dict[str, int] = {}
        self._present: dict[str, str] = {}  # node -> role
        self._note = 'starting'
        self._references = references.of(settings)
        self.leavers = Leavers()

    def __enter__(self) -> 'Progress':
        super().__enter__()
        if self._live is not None:
            self.tick()
        return self

    def go_on(self) -> None:
        """Note that all received so far is of an earlier time: speed is measured from here."""
        self._marks.clear()
        self._marks.append((self._clock(), self.steps))

    def receive(self, record: Record) -> None:
        """Note a record of the run."""
        if isinstance(record, Commit):
            for news in self.leavers.receive(record):
                self.log(news)
            if record.phase >= self._phase:
                self._phase = record.phase + 1
                self._marks.append((self._clock(), self.steps))
                self._note = ''
        elif isinstance(record, Metrics):
            for name, value in zip(record.names, record.values.tolist(), strict=True):
                self._metrics[name] = value
        elif isinstance(record, EpisodeResult):
            self._take(record)
        elif isinstance(record, Presence):
            self._present[record.node] = record.role
            self._missed[record.node] = record.missed
        self.tick()

    def _take(self, result: EpisodeResult) -> None:
        if result.purpose == 'random':
            self._random.append(result)
            if len(self._random) == self._settings.evaluate_episodes:
                self.log(f'random policy: {self._of(self._random)}', 'dim')
        elif result.purpose == 'evaluation':
            if self._evaluation and self._evaluation[0].version != result.version:
                self._evaluation = []
            self._evaluation.append(result)
            if len(self._evaluation) == self._settings.evaluate_episodes:
                self.log(f'after {result.step} steps: {self._of(self._evaluation)}')
                beside = self._references.beside(result.step) if self._references else ''
                if beside:
                    self.log(f'    others by then, recorded before: {beside}', 'dim')

    @property
    def steps(self) -> int:
        """Environment steps of the phases committed so far."""
        return self._settings.steps_after(self._phase - 1)

    @property
    def lost(self) -> int:
        """Messages that were published and, by the nodes' counts, never reached them."""
        return sum(self._missed.values())

    @property
    def rate(self) -> float:
        """Environment steps per second over the last phases; 0 before the first."""
        (then, before), (now, steps) = self._marks[0], self._marks[-1]
        return (steps - before) / (now - then) if now > then else 0.0

    @property
    def seconds_left(self) -> float | None:
        """An estimate from the present speed; None before the first phase."""
        return (self._settings.steps - self.steps) / self.rate if self.rate else None

    @staticmethod
    def _of(results: list[EpisodeResult]) -> str:
        true = np.array([r.true_return for r in results])
        score = float(np.mean([r.score for r in results]))
        many = f'{len(results)} episode' + ('s' if len(results) > 1 else '')
        mean, spread = returns(float(true.mean()), float(true.std()))
        return f'true return {mean} +- {spread}, score {score:.3f} ({many})'

    def _facts(self) -> list[tuple[str, str]]:
        left = self.seconds_left
        facts = [
            ('phase', f'{self._phase} of {self._settings.phases}'),
            ('steps', f'{self.steps} of {self._settings.steps}, {self.rate:.0f} per second'),
        ]
        if self._evaluation:
            facts.append(('evaluation', self._of(self._evaluation)))
        if 'reward_loss' in self._metrics:
            facts.append(('reward loss', exact(self._metrics['reward_loss'], 4)))
        if 'critic_loss' in self._metrics:
            facts.append(('critic loss', exact(self._metrics['critic_loss'], 4)))
        facts.append(('lost messages', str(self.lost)))
        if out := self.leavers.now():
            facts.append(('left out', out))
        spent = duration(self._clock() - self._began)
        facts.append(
            ('time', spent + (f', about {duration(left)} left' if left is not None else ''))
        )
        return facts

    def _plain(self) -> None:
        facts = [f'{name} {text}' for name, text in self._facts() if name != 'evaluation']
        self.log(', '.join(([self._note] if self._note else []) + facts))

    def _render(self) -> RenderableType:
        table = Table.grid(padding=(0, 2))
        for name, text in self._facts():
            bad = (name == 'lost messages' and self.lost > 0) or name == 'left out'
            table.add_row(Text(name, style='dim'), Text(text, style='bold red' if bad else ''))
        nodes = ', '.join(sorted(node.rsplit('/', 1)[-1] for node in self._present))
        notes = [f'{self._note}...'] if self._note else []
        notes += [f'nodes: {nodes}'] if nodes else []
        whole = Table.grid()
        if notes:
            whole.add_row(Text('  '.join(notes), style='dim'))
        whole.add_row(ProgressBar(total=self._settings.steps, completed=self.steps, width=60))
        whole.add_row(table)
        return whole
