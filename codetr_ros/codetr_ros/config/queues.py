"""How many messages may be under way on each topic, and so how deep its queues are.

Topics that a late node must still receive (`run`, `task`, `policy`, `commits`, `score_requests`)
are transient local. Every queue is deeper than the number of messages that the permitted phases
can put on its topic: KEEP_LAST would drop the rest silently, and KEEP_ALL blocks the publisher.
The depth is `max(FLOOR, MARGIN * most)`. The table gives `most` for P = ahead + 1 phases (one more
than are ever permitted and not yet committed) of N = phase_steps steps, all sources together:

    transitions, true_rewards   P * N                       a chunk has at least one step
    composite_rewards           P * N                       a segment has at least one step, and
                                                            no scorer may give more
    preferences                 P * N                       no scorer may give more
    episodes                    P * N + evaluate_episodes   an episode has at least one step
    step_rewards                P * (sources + ceil(16 * memory_steps / 100 kB))
                                                            at most 4 bytes for each label and 12
                                                            for its segment, in parts of more than
                                                            half of 200 kB
    metrics                     P * (4 + simulators) * 4    a few from each node and phase
    policy                      P + ceil(4000 / N)          those that come during an evaluation
                                                            episode are added
    commits, score_requests     P                           one for each phase
    task                        sources                     one for each source

A depth costs nothing by itself: the middleware stores messages that were published and reserves
no room for others.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import ceil

from codetr_ros.config.run import Settings
from codetr_ros.records.checks import most_parts

FLOOR = 16
MARGIN = 1.25


@dataclass(frozen=True)
class Quality:
    """Durability of a topic, and the most messages that may be under way on it."""

    transient_local: bool
    most: Callable[[Settings], int]


def _phases(settings: Settings) -> int:
    return settings.ahead + 1


def _steps(settings: Settings) -> int:
    return _phases(settings) * settings.phase_steps


QUALITIES: dict[str, Quality] = {
    'run': Quality(True, lambda s: 1),
    'presence': Quality(False, lambda s: 256),
    'task': Quality(True, lambda s: s.source_count),
    'policy': Quality(True, lambda s: _phases(s) + ceil(4000 / s.phase_steps)),
    'transitions': Quality(False, _steps),
    'composite_rewards': Quality(False, _steps),
    'preferences': Quality(False, _steps),
    'commits': Quality(True, _phases),
    'score_requests': Quality(True, _phases),
    'step_rewards': Quality(
        False,
        lambda s: _phases(s) * most_parts(s),
    ),
    'episodes': Quality(False, lambda s: _steps(s) + s.evaluate_episodes),
    'true_rewards': Quality(False, _steps),
    'metrics': Quality(False, lambda s: _phases(s) * (4 + s.simulators) * 4),
}


def depth(topic: str, settings: Settings | None = None) -> int:
    """Depth of a topic's queues, at both ends.

    Args:
        topic: relative name, one of `records.TOPICS`.
        settings: the settings of the run; not needed for `run` and `presence`, which are opened
            before the settings are known.
    """
    return max(FLOOR, ceil(MARGIN * QUALITIES[topic].most(settings or Settings())))
