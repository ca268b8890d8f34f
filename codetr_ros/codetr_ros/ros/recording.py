"""The recorder's wiring: writes messages as they arrive, and commits phases.

`nodes/keeping.py` decides what goes into the bag. A commit goes into it after all records that it
names, and out to the nodes only after the bag is flushed and synced. So nobody
learns from what could be lost, and the bag names the records of every phase that anybody has
learnt from.

A recorder that is started again in the folder of its run goes on with the bag, and asks all other
nodes for what it has missed. The service `fetch_phase` sends any committed phase again from the
bag; without a bag, the last ones from memory.
"""

import time
from collections import deque
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any, cast

from codetr_ros.bags.topics import RECORDED, topics_of_run
from codetr_ros.cores.recorder import Recorder
from codetr_ros.nodes.asking import SERVICE
from codetr_ros.nodes.keeping import Keeper, Keeping
from codetr_ros.nodes.kept_run import KeptRun
from codetr_ros.records import TOPICS, Commit, Record, RunSpec
from codetr_ros.ros.fetch import askers
from codetr_ros.ros.gathering import IDLE
from codetr_ros.ros.joining import Joined
from codetr_ros.ros.membership import Membership
from codetr_ros.ros.resend import PhaseService
from codetr_ros.ros.wiring import Wiring
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs.reports import BagReport

BEHIND = 0.5
"""The most seconds that a commit waits for true rewards, which come right behind the steps."""


class Recording(Wiring):
    """The wiring of the recorder's core: to a bag, and to all topics."""

    def __init__(self, member: Membership, joined: Joined) -> None:
        super().__init__(member, joined)
        settings = joined.settings
        names = {k: member.link.node.resolve_topic_name(TOPICS[k]) for k in RECORDED}
        self._bag = KeptRun(
            self._bag_folder(),
            dict(zip(RECORDED, topics_of_run(names, settings), strict=True)),
            settings.ahead + 2,
            settings.phase_steps,
            round(member.values['bag_split_mb'] * 1e6),
            round(member.values['bag_keep_free_mb'] * 1e6),
        )
        # the newest commits: published again by a recorder that was started again
        self._commits: deque[Commit] = deque(maxlen=settings.ahead + 1)
        self._keeping = Keeping(
            Keeper(
                who=member.link.full_name,
                run=joined.run,
                settings=settings,
                core=cast(Recorder, joined.core),
                bag=self._bag,
                traffic=member.traffic,
                peers=member.peers,
                limit=member.limit,
                leave_out_after=member.values['leave_out_after'],
                make=askers(member.link, joined.run.run_id),
                note_own=member.note_own,
                log=member.log,
                stamp=lambda: member.link.node.get_clock().now().nanoseconds,
            )
        )

    def open(self) -> None:
        """Open the bag, then subscribe to everything as raw bytes."""
        settings, link, bag = self.joined.settings, self.member.link, self._bag
        run_id = self.joined.run.run_id
        bag.open(run_id, self._restore)
        if bag.gone_on:
            self.log.info(f'goes on with {bag.folder}, behind phase {bag.newest}')
        elif bag.folder:
            self.log.info(f'records to {bag.folder}')
        if not bag.recorded[TOPICS[RunSpec]]:
            self._keeping.write(self.joined.run, self.member.announcement)
        for kind in RECORDED:
            if kind not in (RunSpec, Commit):  # the first has arrived, the second is our own
                link.subscribe(kind, self.take, settings)
        PhaseService(link, SERVICE, run_id, self._read, lambda: bag.newest)
        for commit in self._commits:  # and by the counts of its presence others know of them
            link.publish(commit)

    def _read(self, phase: int, kinds: Collection[str]) -> Iterable[tuple[type, bytes]]:
        """The messages of a phase, as the nodes of this run take them."""
        found = self._bag.read(phase, kinds)
        if not self._bag.gone_on:
            return found
        return ((kind, self.member.link.signed_again(kind, raw)) for kind, raw in found)

    def _restore(self, record: Record, data: bytes) -> None:
        """Take a record that the bag holds already."""
        if isinstance(record, Commit):
            self._commits.append(record)
        self._keeping.restore(record)

    def go_on(self) -> bool:
        """Ask all nodes for what was missed, if the bag was there before."""
        self._keeping.go_on()
        return True

    def _bag_folder(self) -> Path | None:
        if self.member.values['bag']:
            return Path(self.member.values['bag'])
        return self.joined.folder and self.joined.folder / run_folder.BAG

    def take(self, kind: type, message: Any) -> None:
        """Take the bytes of a message: what is admitted is written as it came."""
        self._keeping.take(kind, message)

    def deliver(self, given: Any) -> None:
        """Publish a record of the core; a commit only after all that it names is on the disk."""
        link = self.member.link
        if not isinstance(given, Commit):
            super().deliver(given)
            return
        while not self.member.stop and self._keeping.catches_up():
            self.member.turn(IDLE)
        end = time.monotonic() + BEHIND
        while self._keeping.lacks_true_rewards(given) and time.monotonic() < end:
            self.member.turn(IDLE)
        self._bag.check_room()
        raw = link.message(given)
        self._keeping.write(given, raw)
        self._bag.flush()
        link.send(TOPICS[Commit], raw)

    def held(self) -> None:
        """Ask all nodes for what was published while nothing was read."""
        self._keeping.held()

    # ---- waiting

    def waits(self) -> str:
        """What the recorder waits for, in words. What was lost on the way is asked for again, and
        who is silent for too long is left out.
        """
        self._keeping.look_after()
        return super().waits()

    def asked_for(self) -> Mapping[str, float]:
        """Topics of what the recorder asks for: all that it records."""
        return self._keeping.asked_for

    def settled(self, seconds: float) -> bool:
        """Whether all nodes have finished and all their records are in the bag.

        Raises:
            NodeError: a node has ended too early, or records never arrived.
        """
        settled, self.member.doing = self._keeping.settled(seconds)
        return settled

    def close(self) -> None:
        """Finish the bag."""
        self._bag.close()

    def report(self) -> BagReport:
        """What was recorded, and where."""
        return self._bag.report()
