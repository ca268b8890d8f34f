"""Decides whether a robot may be driven by a policy now, and if not, why.

A stop and a speed beyond its limit last until a person lets the robot go on. Silence ends by
itself: what was missing is there again.
"""

from typing import NamedTuple

from codetr_ros.robots.live import Live
from codetr_ros.robots.senses import Senses

STOP, PAUSE, SPEED = 'stop', 'pause', 'speed'
OBSERVATION, HEARTBEAT, LEARNER = 'observation', 'heartbeat', 'learner'
CLOCK = 'clock'


class Hold(NamedTuple):
    """Why a robot gets the safe command."""

    kind: str
    why: str  # in words


class Guard:
    """Watches over what must go on. All times are seconds of one clock that never goes back.

    Args:
        live: the part of the mapping.
        senses: what the robot observes.
        now: when watching begins: what never comes is missed from then on.
    """

    def __init__(self, live: Live, senses: Senses, now: float) -> None:
        self._rules = live
        self._senses = senses
        self._stop: str | None = None  # why
        self._pressed = False  # the stop topic has brought true, and no false since
        self._speed: str | None = None
        self.paused = False
        self.interrupted: Hold | None = None
        """Why the next control step is held, whatever it sees."""
        self.restart(now)

    def restart(self, now: float) -> None:
        """Watch from now on, as if everything had just come: another clock, or one set back."""
        self._stop_at = self._heartbeat_at = self._learner_at = now

    # ---- what arrives

    def stop(self, why: str) -> None:
        """Stop the robot until a person lets it go on."""
        self._stop = self._stop or why

    def stop_message(self, pressed: bool, now: float) -> None:
        """Take a message of the stop topic."""
        self._stop_at = now
        self._pressed = pressed
        if pressed:
            self.stop(f'{self._rules.stop.topic} is true')

    def heartbeat(self, now: float) -> None:
        """Take a heartbeat."""
        self._heartbeat_at = now

    def learner(self, now: float) -> None:
        """Take a sign of life of the learner."""
        self._learner_at = now

    def resume(self) -> str | None:
        """Let a person end a stop, a pause and a speed that was too high.

        Returns:
            Why the robot stays stopped; None if it does not.
        """
        if self._pressed:
            return f'{self._rules.stop.topic} is still true: release the stop first'
        self._stop = self._speed = None
        self.paused = False
        return None

    # ---- what follows

    @property
    def stopped(self) -> bool:
        """Whether a stop lasts."""
        return self._stop is not None

    def look(self, now: float) -> Hold | None:
        """Why the robot must be held now, the gravest reason first; None if nothing is amiss."""
        stop, watchdog = self._rules.stop, self._rules.watchdog
        if stop.age is not None and now - self._stop_at > stop.age:
            self.stop(f'{stop.topic} was silent for more than {stop.age:g} s')
        if self._stop is not None:
            return Hold(STOP, self._stop)
        if (fast := self._senses.too_fast()) and self._speed is None:
            self._speed = fast
        if self._speed is not None:
            return Hold(SPEED, self._speed)
        if self.interrupted is not None:
            held, self.interrupted = self.interrupted, None
            return held
        if self.paused:
            return Hold(PAUSE, 'a person has paused it')
        if old := self._senses.old(now):
            return Hold(OBSERVATION, '; '.join(old))
        if watchdog.heartbeat is not None and now - self._heartbeat_at > watchdog.heartbeat_age:
            silent = now - self._heartbeat_at
            return Hold(HEARTBEAT, f'{watchdog.heartbeat} was silent for {silent:.2f} s')
        if watchdog.learner and now - self._learner_at > watchdog.learner:
            return Hold(LEARNER, f'the learner was silent for {now - self._learner_at:.1f} s')
        return None
