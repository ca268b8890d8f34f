"""From an action in [-1, 1] to the command that leaves: the scaling, and the limits of the robot.

Whoever drives the robot, learning or not, passes each action through here. What was commanded
after the limits is also returned as an action, for that is what the robot did.
"""

from dataclasses import dataclass

import numpy as np

from codetr_ros.records import F32, F64
from codetr_ros.robots.live import HOLD, expanded
from codetr_ros.robots.mapping import Mapping

RANGE, CHANGE, POSITION = 'range', 'change', 'position'
"""The names of limits that have changed a command."""


@dataclass(frozen=True, eq=False)
class Commanded:
    """A command within the limits.

    Attributes:
        command: (A,) in units of the robot.
        action: (A,) the same in [-1, 1]; the very action that was asked for, where no limit
            changed it.
        changed_by: the limits that changed the command.
    """

    command: F64
    action: F32
    changed_by: tuple[str, ...]


class Limiter:
    """Scales actions to commands, and keeps these within the limits of a mapping.

    Args:
        rules: the mapping; its part `live` must be there.
    """

    def __init__(self, rules: Mapping) -> None:
        live = rules.live
        assert live is not None
        action, limits = rules.action, live.limits
        self.size = size = live.size(action.low, action.high, len(action.joints or ()))
        self._kind = live.command.kind
        self._low, self._high = expanded(action.low, size), expanded(action.high, size)
        self._least = self._low if limits.low is None else expanded(limits.low, size)
        self._most = self._high if limits.high is None else expanded(limits.high, size)
        change = limits.change
        self._step = None if change is None else expanded(change, size) * live.period
        self._position = limits.position
        if limits.position is not None:
            self._lowest = expanded(limits.position.low, size)
            self._highest = expanded(limits.position.high, size)
        safe = live.command.safe
        self._safe = None if safe == HOLD else expanded(safe, size)  # type: ignore[arg-type]

    def scaled(self, action: F32) -> F64:
        """The command (A,) that an action (A,) in [-1, 1] asks for."""
        middle, half = (self._high + self._low) / 2, (self._high - self._low) / 2
        asked: F64 = np.clip(middle + half * action.astype(np.float64), self._low, self._high)
        return asked

    def command(self, action: F32, before: F64 | None, positions: F64 | None) -> Commanded:
        """The command that an action becomes.

        The measured positions have the last word: near their limits a command may change faster
        than `change` allows.

        Args:
            action: (A,) in [-1, 1], finite.
            before: (A,) the last command that was sent, or what `rest` gives; None: not known.
            positions: (A,) as measured; None where the mapping names none.
        """
        asked = self.scaled(action)
        made, changed = asked, []
        for name, low, high in self._bounds(before, positions):
            kept = np.minimum(np.maximum(made, low), high)
            if (kept != made).any():
                changed.append(name)
                made = kept
        if not changed:
            return Commanded(made, action, ())
        took = 2 * (made - self._low) / (self._high - self._low) - 1
        return Commanded(made, np.clip(took, -1, 1).astype(np.float32), tuple(changed))

    def _bounds(self, before: F64 | None, positions: F64 | None) -> list[tuple[str, F64, F64]]:
        """Each limit's name, and the least and the most that it allows."""
        bounds = [(RANGE, self._least, self._most)]
        if self._step is not None and before is not None:
            bounds.append((CHANGE, before - self._step, before + self._step))
        if self._position is None or (positions is None and self._kind != 'position'):
            return bounds
        if self._kind == 'position':
            return [*bounds, (POSITION, self._lowest, self._highest)]
        assert positions is not None
        up, down = self._highest - positions, self._lowest - positions
        if self._kind == 'velocity':
            ahead = self._position.ahead
            room = np.maximum(0.0, up / ahead), np.minimum(0.0, down / ahead)
        else:
            room = np.where(up > 0, np.inf, 0.0), np.where(down < 0, -np.inf, 0.0)
        return [*bounds, (POSITION, room[1], room[0])]

    def rest(self, positions: F64 | None) -> F64 | None:
        """What a robot that has had no command is taken to do (A,): it holds the positions that
        were measured, if it is driven by position, or obeys its safe command.
        """
        if self._kind == 'position' and positions is not None:
            return positions.copy()
        return self.safe(positions)

    def safe(self, positions: F64 | None) -> F64 | None:
        """The safe command (A,); None where it is to hold positions that were never measured."""
        if self._safe is not None:
            return self._safe.copy()
        return None if positions is None else positions.copy()
