"""The evaluator: measures the policies without noise, beside the run, and never delays it."""

from collections import Counter, deque
from collections.abc import Iterator

from codetr_ros.config import Settings
from codetr_ros.cores.core import Part
from codetr_ros.policy.acting import ActingPolicy, uniform_actions
from codetr_ros.records import INITIAL_VERSION, EpisodeResult, Record, RunSpec
from codetr_ros.records.roles import subscribed
from codetr_ros.runs.reports import CoreReport
from codetr_ros.seeding import generator, seed_global
from codetr_ros.simulation.episode import EpisodeRunner
from codetr_ros.simulation.permission import acting_policy, check_policy
from codetr_ros.simulation.tasks import make


class Evaluator(Part):
    """Evaluates policy versions: `evaluate_episodes` episodes each, with deterministic actions.

    Every evaluation of a run begins its episodes in the same start states. The first evaluation is
    that of the uniformly random policy, the baseline. With `evaluate_every` = 0 there is none.

    Args:
        run: the run it belongs to.
        settings: the settings of the run.
        name: its name, the source of its results.

    Raises:
        TaskError: the task is unknown or cannot be used.
        SettingsError: the delay exceeds the task's horizon.
    """

    subscribes = subscribed('evaluate')

    def __init__(self, run: RunSpec, settings: Settings, name: str) -> None:
        super().__init__()
        self._run = run
        self._settings = settings
        self._name = name
        seed_global(settings.seed, 'environment')  # the same as the simulator's
        self._environment = make(settings.task)
        self._episode = EpisodeRunner(self._environment, settings, 'evaluate')
        self._waiting: deque[tuple[str, int, ActingPolicy | None]] = (
            deque()
        )  # purpose, version, policy
        self._seen: set[int] = set()  # versions that are evaluated or wait for it
        self._awaited = 0  # of the versions before it, none is awaited
        self._done: dict[int, set[int]] = {}  # episodes of each that were evaluated before
        self._counters: Counter[str] = Counter()
        self._closed = False

    def restore(self, record: Record) -> None:
        """Take one of the results that it has published before: that episode is not run again.
        Others' results, and other kinds of records, are passed over.
        """
        if not isinstance(record, EpisodeResult) or record.purpose == 'training':
            return
        done = self._done.setdefault(record.version, set())
        if record.episode in done:
            return
        done.add(record.episode)
        self._counters.update(episodes=1, steps=record.length)
        if len(done) == self._settings.evaluate_episodes:
            self._seen.add(record.version)
            self._count(record.version)

    def has_evaluated(self, version: int) -> bool:
        """Whether all episodes of a version's evaluation have been restored."""
        return len(self._done.get(version, ())) == self._settings.evaluate_episodes

    def receive(self, record: Record) -> None:
        """Keep a policy whose version is due for evaluation.

        Raises:
            RecordError: it is of another run, or its weights do not fit; nothing has changed then.
        """
        settings = self._settings
        policy = check_policy(record, self._run, settings, f'evaluator {self._name!r}')
        if settings.evaluate_every == 0:
            self.finished = self.finished or policy.version == settings.phases - 1
            return
        if policy.random and policy.phase == 0 and INITIAL_VERSION not in self._seen:
            self._seen.add(INITIAL_VERSION)
            self._waiting.append(('random', INITIAL_VERSION, None))
        if settings.evaluated(policy.version) and policy.version not in self._seen:
            acting = acting_policy(policy, self._environment, settings)
            self._seen.add(policy.version)
            self._waiting.append(('evaluation', policy.version, acting))

    @property
    def unpermitted(self) -> int | None:
        """The phase whose policy has the next version to be evaluated; None if there is none."""
        settings = self._settings
        if self.finished:
            return None
        if settings.evaluate_every == 0:  # it waits for the end of the run
            return settings.phases - 1 + settings.lag
        if INITIAL_VERSION not in self._seen:
            return 0
        # asked in each turn: what was passed over once is not looked at again
        while self._awaited < settings.phases and (
            self._awaited in self._seen or not settings.evaluated(self._awaited)
        ):
            self._awaited += 1
        return None if self._awaited == settings.phases else self._awaited + settings.lag

    def waiting_for(self) -> str:
        """What the next slice waits for, for people."""
        return 'a policy that is to be evaluated, from the learner'

    def work(self) -> Iterator[list[Record] | None]:
        """Evaluate one episode per slice."""
        while True:
            if not self._waiting:
                yield None
                continue
            purpose, version, acting = self._waiting.popleft()
            done = self._done.pop(version, set())
            due = [n for n in range(self._settings.evaluate_episodes) if n not in done]
            for episode in due:
                result = self._evaluate(purpose, version, acting, episode)
                if episode == due[-1]:
                    self._count(version)
                yield [result]

    def _count(self, version: int) -> None:
        """Count an evaluation that is complete."""
        self._counters['evaluations'] += 1
        self.finished = self.finished or version == self._settings.phases - 1

    def _evaluate(
        self, purpose: str, version: int, acting: ActingPolicy | None, number: int
    ) -> EpisodeResult:
        """Run one episode, from the start state that its number gives."""
        seed, episode, environment = self._settings.seed, self._episode, self._environment
        begin(episode, seed, number)
        if acting is None:
            rng = generator(seed, 'evaluate', 'random', number)
            actions = uniform_actions(rng, environment.horizon, environment.action_size)
        while not episode.over:
            if acting is None:
                action = actions[episode.length]
            else:
                action = acting.act(episode.observation, step=episode.place)
            episode.step(action)
        self._counters.update(episodes=1, steps=episode.length)
        step = self._settings.steps_after(version)  # 0 for the initial version
        return episode.result(self._run.run_id, self._name, purpose, step, version, number)

    def close(self) -> None:
        """Close the environment. An evaluator keeps no checkpoint."""
        if not self._closed:
            self._closed = True
            self._environment.close()

    def report(self) -> CoreReport:
        """Counts for the run's summary."""
        return CoreReport(lost={}, duplicated={}, counters=dict(self._counters))


def begin(episode: EpisodeRunner, seed: int, number: int) -> None:
    """Begin an episode of an evaluation.

    Args:
        episode: runs it.
        seed: of the run.
        number: of the episode within the evaluation; it decides the start state.
    """
    seed_global(seed, 'environment', 'evaluate', number)
    episode.reset(int(generator(seed, 'evaluate', number).integers(2**31)), number)
