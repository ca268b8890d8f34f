"""Where a run's settings cut its episodes into segments."""

from collections.abc import Iterator
from dataclasses import dataclass

from codetr_ros.config.delays import Lengths, delay_in_words

MOST_STEPS = 10_000_000
"""Steps of an episode beyond which no lengths are drawn."""


@dataclass(frozen=True)
class Cuts:
    """Where a run's settings cut episodes into segments."""

    delay: int | str
    seed: int

    def segments(
        self, source: str, episode: int, before: int, after: int, ended: bool
    ) -> Iterator[tuple[int, int]]:
        """First step and length of each segment of an episode that ends with some of its steps.

        Args:
            source: whose episode it is.
            episode: its number.
            before: steps of it before those.
            after: steps of it with those.
            ended: whether it has ended with them, so that the last segment may be shorter.
        """
        lengths = Lengths.of(self.delay)
        first = begin = 0
        if lengths.drawn:
            if after > MOST_STEPS:
                return  # a wild number must not take memory
        elif lengths.most:  # what is missing, however long, is passed over
            first = begin = before // lengths.most * lengths.most
        ends = lengths.ends(self.seed, source, episode, after - begin)
        for end in (ends + begin).tolist():
            if end > before:
                yield first, end - first
            first = end
        if ended and first < after:
            yield first, after - first

    def __str__(self) -> str:
        return delay_in_words(self.delay)
