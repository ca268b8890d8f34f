"""The counts of a conversion: what was made, and everything that was dropped."""

from collections import Counter
from dataclasses import dataclass, field

from codetr_ros.records.checks import LARGEST_SCORE

SCORE_NOT_FINITE = 'scores that are not finite'
SCORE_TOO_LARGE = f'scores beyond {LARGEST_SCORE:g}'
SCORE_OF_NOTHING = 'scores of no step, or of fewer than are asked for'
SCORE_AGAIN = 'scores of steps that were scored before'
SCORE_SECOND = 'second scores of the same steps, the first was kept'
SCORE_REPLACED = 'scores that a later score of the same steps replaced'
SCORE_DROPPED = 'scores of steps that were dropped'
SCORE_TRIMMED = 'scores whose last step was dropped, taken as of those before it'
SCORE_OF_EITHER = 'scores that may be of the episode before, whose last steps had no score yet'
SCORE_ACROSS = 'scores of steps of more than one episode'
SCORE_OF_PART = 'scores of an episode in which steps are missing'
SCORE_LATE = 'scores that came later than `late`'
SCORE_AHEAD = 'scores whose stamp is later than the end of the bag'
SCORE_WITHOUT_EPISODE = 'scores of an episode that is not there'
SCORE_OF_NAMESAKES = 'scores whose `id` is that of more than one episode'
JOINTS_DOUBLED = 'messages whose joints jump there and back, kept'

HINTS = {
    JOINTS_DOUBLED: 'two nodes seem to publish the same joints on one topic, as '
    'joint_state_publisher may beside a driver. The bag does not show which message is of which: '
    'record again with one of them, or filter its messages out of the bag',
    SCORE_OF_EITHER: 'when a score comes while an episode runs, and the end of the one before had '
    'no score, nothing shows which one it is of. Give score.late: 0 if scores never come '
    'after the next episode has begun, or the seconds by which they may; or let score.of be '
    'last_episode, or give score.stamp or score.id',
    SCORE_OF_NAMESAKES: 'give score.late, so that a name is looked for among recent episodes only',
    SCORE_AHEAD: 'the clock that stamps the scores is not the one that the steps are timed by',
}
"""What to do about some of the counts."""


@dataclass
class Conversion:
    """The counts of a conversion."""

    messages: Counter[str] = field(default_factory=Counter)  # read, by topic
    episodes: int = 0
    steps: int = 0
    scores: int = 0
    scored_steps: int = 0
    fewest: int = 0  # steps of a score
    most: int = 0
    dropped: Counter[str] = field(default_factory=Counter)
    sizes: tuple[int, int] = (0, 0)  # of observations and actions
    shortest: float = float('inf')  # [s] between the begins of two steps
    longest: float = 0.0
