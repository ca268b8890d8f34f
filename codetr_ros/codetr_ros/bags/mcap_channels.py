"""The topics and definitions that an MCAP file has described so far."""

from collections.abc import Iterable
from contextlib import suppress
from typing import Any

from mcap import records as mcap_records

from codetr_ros.bags.mcap_layout import FaultError
from codetr_ros.bags.raw import LIBRARY, Channel
from codetr_ros.bags.schemas import Definition
from codetr_ros.records.names import full_type_name


class McapChannels:
    """Channels by their number, each with the definition of its message type.

    Attributes:
        library: the program that wrote the file, as its header names it.
    """

    def __init__(self) -> None:
        self.library = ''
        self._schemas: dict[int, Any] = {}
        self._records: dict[int, Any] = {}
        self._channels: dict[int, Channel] = {}

    def all(self) -> list[Channel]:
        """The topics that have been described."""
        return list(self._channels.values())

    def of(self, number: int) -> Channel | None:
        """The channel of this number, once the file has described it."""
        return self._channels.get(number)

    def take(self, record: Any) -> None:
        """Note a schema or channel record, and ignore any other.

        Raises:
            FaultError: it contradicts an earlier one, or its definition is missing.
        """
        if isinstance(record, mcap_records.Schema):
            _keep(self._schemas, record)
        elif isinstance(record, mcap_records.Channel):
            _keep(self._records, record)
            self._channels[record.id] = self._channel(record)

    def borrow(self, records: Iterable[Any]) -> None:
        """Take what the file has not described so far from a summary, which repeats all of it: the
        chunk with the description may be the damaged one.
        """
        for record in records:
            if isinstance(record, mcap_records.Schema):
                self._schemas.setdefault(record.id, record)
            elif isinstance(record, mcap_records.Channel) and record.id not in self._records:
                with suppress(FaultError):  # a writer need not repeat the definitions there
                    self._channels[record.id] = self._channel(record)
                    self._records[record.id] = record

    def _channel(self, record: Any) -> Channel:
        schema = self._schemas.get(record.schema_id)
        if schema is None and record.schema_id:
            raise FaultError(f'topic {record.topic} has a definition that the file does not have')
        digest = record.metadata.get('topic_type_hash', '')
        qos = record.metadata.get('offered_qos_profiles', '')
        if schema is None:
            return Channel(
                record.topic, '', record.message_encoding, Definition('', '', digest), qos
            )
        text = schema.data.decode('utf-8', 'replace')
        definition = Definition(schema.encoding, text, digest)
        name = full_type_name(schema.name)
        ours = self.library.startswith(LIBRARY)
        return Channel(record.topic, name, record.message_encoding, definition, qos, ours)


def _keep(known: dict[int, Any], record: Any) -> None:
    if known.setdefault(record.id, record) != record:
        raise FaultError(f'{type(record).__name__} {record.id} is described twice, differently')
