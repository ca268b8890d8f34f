"""Brings what nodes publish to those that read it, over the simulated network."""

from collections.abc import Callable, Mapping
from dataclasses import replace

from codetr_ros.bags.definitions import decode, encode, stamp_of
from codetr_ros.bags.topics import RECORDED
from codetr_ros.records import CompositeReward, Presence, Record, Transitions
from codetr_ros.simtest.network import FORGED, Handle, Network, Weather
from codetr_ros.simtest.place import Packet
from codetr_ros.simtest.process import Process
from codetr_ros.simtest.world import World

STRANGER = 'stranger'
"""The run of messages that are of another one."""
Watch = Callable[[type, bytes, Process], None]
"""Looks at a message that arrives at a node."""


def forged(record: Record) -> Record:
    """Steps or a score of the same number that are well-formed, and wrong."""
    if isinstance(record, Transitions):
        return replace(record, actions=-record.actions)
    assert isinstance(record, CompositeReward)
    return replace(record, value=record.value + 1)


class Post:
    """Knows who reads what.

    Attributes:
        processes: the nodes, by name.
        watch: looks at every message when it arrives.
        network: carries the messages.

    Args:
        world: where it is.
        weather: how the network behaves.
    """

    def __init__(self, world: World, weather: Weather) -> None:
        self.processes: Mapping[str, Process] = {}
        self.watch: Watch = lambda kind, raw, reader: None
        self.network = Network(world, weather)
        self._world = world
        self._weather = weather

    def _reads(self, reader: Process, kind: type) -> bool:
        if kind is Presence:
            return True
        return kind in RECORDED if reader.role == 'record' else kind in reader.core.subscribes

    def publish(self, sender: Process, packet: Packet) -> None:
        """Send a message to everybody who reads its kind; the recorder reads its own too."""
        kind = packet.kind
        ours = kind is Presence or kind.__name__ == 'Commit'  # the recorder has written it
        readers = [
            each.name
            for each in self.processes.values()
            if self._reads(each, kind) and not (each is sender and ours)
        ]
        if kind in FORGED and self._world.rng.random() < self._weather.lies:
            lie = Packet(kind, self._world.number(), encode(forged(decode(kind, packet.data))))
            for reader in readers:
                if reader != 'record':
                    self._world.at(self._world.now, self._arrives(reader, lie))
        self.network.publish(sender.name, readers, kind, lambda name: self._arrives(name, packet))
        if kind is not Presence and self._world.rng.random() < self._weather.strangers:
            strange = replace(decode(kind, packet.data), run_id=STRANGER)
            claimed = encode(strange, stamp_of(packet.data) + 1, sender=sender.instance)
            other = Packet(kind, self._world.number(), claimed)
            self.network.publish(STRANGER, readers, kind, lambda name: self._arrives(name, other))

    def deliver_lasting(self, reader: Process) -> None:
        """Send to a node that is started again what the others keep for late readers."""
        for sender in self.processes.values():
            if sender is reader or sender.ended:
                continue
            for kind, packets in sender.lasting.items():
                for packet in packets if self._reads(reader, kind) else ():
                    ordered = reader.role == 'record'
                    handle = self._arrives(reader.name, packet)
                    self.network.send(sender.name, reader.name, kind, handle, ordered)

    def send(self, sender: Process, reader: str, packet: Packet) -> None:
        """Send a request or an answer to one node."""
        self.network.send(sender.name, reader, packet.kind, self._arrives(reader, packet), True)

    def _arrives(self, name: str, packet: Packet) -> Handle:
        def handle() -> None:
            reader = self.processes[name]  # that lives now
            if isinstance(packet.data, bytes):
                self.watch(packet.kind, packet.data, reader)
            reader.arrive(packet)

        return handle
