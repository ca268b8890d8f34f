"""How a node joins a run: know it, take its settings, make the core, wait until all are there."""

import secrets
import sys
import time
from collections.abc import Callable
from pathlib import Path

from codetr_ros.config import IN_PROCESS_ONLY, Settings, from_canonical
from codetr_ros.records import Commit, Presence, RunSpec
from codetr_ros.records.roles import WRITERS, published_by, readers
from codetr_ros.ros import parameters
from codetr_ros.ros.errors import NodeError
from codetr_ros.ros.fetch import Fetcher
from codetr_ros.ros.member import Member
from codetr_ros.ros.patience import NAME_EVERY
from codetr_ros.runs import folder as run_folder
from codetr_ros.simulation import tasks

IDLE = 0.05  # [s] blocked in the executor while there is nothing to do: the longest a signal waits
NAME_PATIENCE = 2.0  # [s] for the name of a node whose topics are known


def refuse_in_process_only(who: str, settings: Settings) -> None:
    """Refuse a method that is no node's business.

    Raises:
        NodeError: the method runs in process only.
    """
    if settings.method in IN_PROCESS_ONLY:
        raise NodeError(
            f'{who}: method = {settings.method!r} {IN_PROCESS_ONLY[settings.method]}, so that it '
            'runs in process only: use '
            f'`codetr train --in-process --method {settings.method}`, or start the learner with '
            f'another method'
        )


def refuse_idle_reward(who: str, role: str, settings: Settings) -> None:
    """Refuse a reward node where nobody wants step rewards.

    Raises:
        NodeError: the policy is learnt from the scores themselves.
    """
    if role == 'reward' and role not in settings.roles:
        raise NodeError(
            f'{who}: method = {settings.method!r} learns from the scores in the learner and needs '
            'no reward node: stop this one, or start the learner with another method'
        )


def refuse_used_folder(who: str, folder: Path, settings: Settings) -> None:
    """Refuse a folder that holds another run.

    Raises:
        NodeError: its settings are not ours, or there are checkpoints in it.
        SettingsError: its settings cannot be read.
    """
    remedy = 'give the parameter folder another one, or remove it'
    if (folder / run_folder.CONFIG).is_file() and run_folder.read_settings(folder) != settings:
        raise NodeError(
            f'{who}: folder {folder} holds another run, its {run_folder.CONFIG} has other '
            f'settings: {remedy}'
        )
    checkpoints = folder / run_folder.CHECKPOINTS
    if checkpoints.is_dir() and (found := sorted(entry.name for entry in checkpoints.iterdir())):
        raise NodeError(
            f'{who}: folder {folder} holds another run, whose checkpoints are in '
            f'{checkpoints} ({", ".join(found[:3])}): {remedy}'
        )


class Joining(Member):
    """A node that becomes part of a run."""

    def _join(self) -> bool:
        """Know the run: make it (the learner) or wait for it. False if asked to stop meanwhile."""
        parameters.check_names(self.link.node, self.role)
        self.values = parameters.declare_own(self.link.node, self.role)
        self.folder = Path(self.values['folder']) if self.values['folder'] else None
        self.link.advertise(['presence'])
        self.link.subscribe(Presence, self._take)
        self.link.subscribe(RunSpec, self._take)
        if self.role == 'learner':
            self._make_run()
        self._tell()
        wanted = f'run {self.values["run_id"]!r}' if self.values['run_id'] else 'a run'
        topic = self.link.node.resolve_topic_name('run')
        remedy = 'start `ros2 run learner_node learner` in this namespace'

        def lacks() -> list[str]:
            return (
                []
                if self.run_spec
                else [f'the learner, which announces {wanted} on {topic!r} ({remedy})']
            )

        if not self._wait_for(lacks):
            return False
        self._enter()
        return True

    def _make_run(self) -> None:
        """Decide what run it is, from our parameters."""
        self.settings = parameters.own_settings(self.link.node, self.values['config'])
        refuse_in_process_only(self.link.full_name, self.settings)
        tasks.check(self.settings, tasks.find(self.settings.task))
        if self.folder:
            refuse_used_folder(self.link.full_name, self.folder, self.settings)
        run_id = (
            self.values['run_id'] or f'{time.strftime("%Y%m%d-%H%M%S")}-{secrets.token_hex(2)}'
        )
        self.run_spec = self.settings.run_spec(run_id)

    def _owner(self) -> str:
        """The learner whose run it is, for errors: its topics are discovered before its name."""
        node = self.link.node
        end = time.monotonic() + NAME_PATIENCE
        while not self.stop:
            names = sorted(
                f'{info.node_namespace.rstrip("/")}/{info.node_name}'
                for info in node.get_publishers_info_by_topic(node.resolve_topic_name('run'))
                if info.node_name != '_NODE_NAME_UNKNOWN_'
            )
            if names or time.monotonic() > end:
                return f'learner {" or ".join(names) or "of the run"}'
            self._turn(IDLE)
        return 'learner of the run'

    def _enter(self) -> None:
        """Take the run's settings, make the core, open the topics."""
        assert self.run_spec is not None
        node = self.link.node
        if self.settings is None:
            owner = self._owner()
            self.settings = from_canonical(
                self.run_spec.settings, f'run {self.run_spec.run_id!r} of {owner}'
            )
            refuse_in_process_only(self.link.full_name, self.settings)
            refuse_idle_reward(self.link.full_name, self.role, self.settings)
            parameters.check_against_run(node, self.settings, owner)
        parameters.declare_settings(node, self.settings)
        self._tell()
        if self.role == 'learner':
            self.link.advertise(['run'], self.settings)
            self.link.publish(self.run_spec)
        make_core = self._load_core()
        if 'torch' in sys.modules:  # the recorder has no torch and needs none
            sys.modules['torch'].set_num_threads(self.settings.threads)
        if (
            self.role == 'learner'
            and self.folder
            and not (self.folder / run_folder.CONFIG).exists()
        ):
            self.folder.mkdir(parents=True, exist_ok=True)
            run_folder.write_settings(self.folder, self.settings)
        checkpoints = self.folder / run_folder.CHECKPOINTS if self.folder else None
        more = {name: self.values[name] for name in parameters.CORE_OF_ROLE.get(self.role, ())}
        self.core = make_core(self.run_spec, self.settings, self.link.name, checkpoints, **more)
        self.link.advertise(published_by(self.role), self.settings)
        self.open_topics(self.settings)
        if Commit in self.core.subscribes:
            self._fetcher = Fetcher(self.link, self.run_spec.run_id, self._receive_again)
        self.log.info(
            f'run {self.run_spec.run_id}: task {self.settings.task}, method {self.settings.method}'
        )
        self._tell()

    def open_topics(self, settings: Settings) -> None:
        """Subscribe to what the core wants."""
        assert self.core is not None
        for record_type in self.core.subscribes:
            self.link.subscribe(record_type, self._take, settings)

    def _gather(self) -> bool:
        """Wait until everybody is there and matched. False if asked to stop meanwhile."""
        if not self._wait_for(self._lacking):
            return False
        self._begun = True
        self.log.info('everybody is there')
        return True

    def _lacking(self) -> list[str]:
        assert self.settings is not None
        assert self.run_spec is not None
        absent = self.peers.absent(self.settings, self.run_spec.settings_hash)
        if absent:
            return absent
        reading = readers(self.settings.labels_steps)
        reads = [topic for topic, roles in reading.items() if self.role in roles]
        return self.link.unmatched(
            published_by(self.role), self._names(reading), readers=True
        ) + self.link.unmatched(reads, self._names(WRITERS), readers=False)

    def _names(self, table: dict[str, tuple[str, ...]]) -> Callable[[str], set[str]]:
        assert self.settings is not None
        roles = set(self.settings.roles)

        def names(topic: str) -> set[str]:
            wanted = [role for role in table[topic] if role in roles]
            return {peer.said.node for role in wanted for peer in self.peers.alive(role)}

        return names

    def _wait_for(self, lacks: Callable[[], list[str]]) -> bool:
        """Wait until nothing is lacking, naming what is; False if asked to stop meanwhile."""
        began = named = time.monotonic()
        deadline = self.values['peer_deadline']
        while not self.stop:
            self._turn(IDLE)
            missing = lacks()
            if not missing:
                return True
            now = time.monotonic()
            doing = f'waits for {"; ".join(missing)}'
            if doing != self._doing:  # somebody has come: the others have their time anew
                self._doing = doing
                began = named = now
            if deadline and now - began > deadline:
                raise NodeError(
                    f'{self.link.full_name} gave up after {deadline:g} s: it {self._doing}. '
                    f'Parameter peer_deadline makes it wait longer'
                )
            if now - named >= NAME_EVERY:
                named = now
                self.log.warning(f'{now - began:.0f} s: {self._doing}')
        return False
