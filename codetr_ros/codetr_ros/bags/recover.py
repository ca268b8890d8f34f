"""Makes a whole bag from what can be read of a damaged one, or of one whose recorder was killed.

Every message that can be read is kept byte for byte, in order, with its times and its number; what
comes twice stays there twice. Nothing is altered and nothing invented: a gap stays a gap, and is
named. A chunk whose CRC is wrong is left out as a whole, since any byte of it may be wrong. The
new bag is MCAP, whatever the old one was.
"""

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from codetr_ros.bags.copying import copy, write_metadata
from codetr_ros.bags.errors import BagError, Damage
from codetr_ros.bags.raw import LIBRARY
from codetr_ros.bags.reader import Bag
from codetr_ros.bags.unfinished import unfinished
from codetr_ros.bags.verify import Verdict, verify

NAMED = 1000
"""Losses that are named one by one; more are only counted."""


@dataclass
class RecoveredBag:
    """A recovered bag, with what was kept and what was lost."""

    old: Path
    new: Path
    messages: Counter[str] = field(default_factory=Counter)  # kept, by topic
    bytes: int = 0  # of the messages that were kept
    lost: int = 0  # bytes of the old bag that could not be read
    faults: int = 0
    unread: int = 0  # of these, places that the disk cannot read
    losses: list[Damage] = field(default_factory=list)
    verdict: Verdict | None = None  # on the new bag

    @property
    def whole(self) -> bool:
        """Whether nothing is missing but what a killed recorder had not finished, as far as the
        numbers of the messages and the disk show.
        """
        return self.verdict is not None and self.verdict.sound and not self.unread

    def note(self, damage: Damage) -> None:
        """Count a fault, and keep it if it is one of the first."""
        self.faults += 1
        self.unread += damage.unread
        self.lost += damage.lost
        if len(self.losses) < NAMED:
            self.losses.append(damage)

    def report(self) -> dict[str, Any]:
        """As JSON."""
        return {
            'old': str(self.old),
            'new': str(self.new),
            'messages': self.messages.total(),
            'topics': dict(sorted(self.messages.items())),
            'bytes': self.bytes,
            'faults': self.faults,
            'unread': self.unread,
            'bytes_lost': self.lost,
            'losses': [
                {'place': str(d.place), 'text': d.text, 'bytes': d.lost} for d in self.losses
            ],
            'verdict': self.verdict.report() if self.verdict else None,
        }


def recover(old: Path | str, new: Path | str) -> RecoveredBag:
    """Copy what can be read of a bag to a new one, and verify the new one.

    Args:
        old: the damaged bag; it is not touched.
        new: a folder that does not exist, or is empty.

    Raises:
        BagError: nothing can be read, or the new bag cannot be written.
    """
    recovered = RecoveredBag(Path(old), Path(new))
    bag = Bag(recovered.old, recovered.note)
    with unfinished(recovered.new, f'recover {old} again') as folder:
        copied = copy(bag.raw(), folder, f'recovered by {LIBRARY}')
        recovered.messages, recovered.bytes = copied.messages, copied.bytes
        if not copied.files:
            raise BagError(
                f'no message of {old} can be read, {new} is not made: '
                + (recovered.losses[0].text if recovered.losses else 'it holds none')
            )
        write_metadata(copied, folder)
    recovered.verdict = verify(recovered.new)
    return recovered
