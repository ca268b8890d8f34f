"""How a robot gets back to its start between two episodes: by nobody, by itself, by a person."""

from collections.abc import Callable

from codetr_ros.robots.guard import Hold
from codetr_ros.robots.live import Reset

RESET = 'reset'


class Resetting:
    """The reset before each episode.

    Args:
        rules: the part of the mapping.
        ask: asks the robot to reset itself; `answered` is called with what it answers.
    """

    def __init__(self, rules: Reset, ask: Callable[[], None]) -> None:
        self._rules = rules
        self._ask = ask
        self._due = True  # the robot must be reset before the next episode
        self._asked: float | None = None  # when it was asked to [s]
        self._ready = False
        self._ready_at: float | None = None
        self.failures = 0
        self._answer = ''

    @property
    def silent(self) -> bool:
        """Whether the robot moves by itself now, and gets no command meanwhile."""
        return self._asked is not None and not self._ready and self._rules.silent

    def begin(self) -> None:
        """Let a reset precede the next episode."""
        self._due, self._asked, self._ready, self._ready_at = True, None, False, None

    def answered(self, done: bool, text: str = '') -> None:
        """Note what the robot answered, if it was asked for this reset."""
        if self._asked is None:
            return
        if done:
            self._ready = True
        else:
            self.failures += 1
            self._answer = text

    def person_is_ready(self) -> bool:
        """Note that a person has reset the robot; returns whether that was waited for."""
        waited = self._due and self._rules.by == 'person' and not self._ready
        self._ready |= waited
        return waited

    def look(self, now: float) -> Hold | None:
        """What an episode still waits for, now [s]; None once the robot is at its start."""
        if not self._due:
            return None
        if self._rules.by == 'nobody':
            self._ready = True
        if not self._ready:
            return self._wait(now)
        if self._ready_at is None:
            self._ready_at = now
        if now - self._ready_at < self._rules.pause:
            return Hold(RESET, f'comes to rest for {self._rules.pause:g} s')
        self._due = False
        return None

    def _wait(self, now: float) -> Hold:
        if self._rules.by == 'person':
            return Hold(RESET, 'waits for a person to reset it and call the service `ready`')
        if self._asked is None or now - self._asked > self._rules.seconds:
            self._asked = now
            self._ask()
        answer = f', whose last answer was {self._answer!r}' if self._answer else ''
        return Hold(RESET, f'waits for {self._rules.service}{answer}')
