"""Commit groups: the events of the next commit, collected in memory.

A *group* is what one commit brings to the disk: an uncompressed chunk and its commit mark.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Final

from eventsrc.base.machine import crc32
from eventsrc.envelope.model import Offset

from . import mcap_records as _mcap
from .channels import NO_SCHEMA, key_channel, schema_of, verbatim_channel
from .durable_files import FsyncPolicy
from .event import MessageFormat, NewEvent
from .mcap_records import MESSAGE_HEAD, Channel, Schema, encode_message_head

MAX_LEADING_BYTES: Final = 2 * 1024 * 1024
"""Size of a group's schemas and channels from which on it takes no further event. A chunk may have
eight times as much."""

_ChannelKey = tuple[str, int, MessageFormat | None]


@dataclass(frozen=True, slots=True)
class Group:
    """The records of offsets ``first`` to before ``following``.

    ``parts`` are the head and the payload of each message by turns; sequence numbers in the heads
    count from offset ``base``. ``definitions`` are the records of the group's channels and of the
    schemas that are new in it, ``schemas`` those of all schemas of the segment so far.
    """

    base: Offset
    first: Offset
    following: Offset
    first_ns: int
    last_ns: int
    definitions: list[bytes]
    parts: list[bytes]
    schemas: list[bytes]

    def encode(self, base: Offset, mark_seed: int) -> tuple[bytes, bytes, bytes]:
        """Chunk head, messages and commit mark for a file that begins at offset ``base`` and has
        that mark seed. Head and messages are not joined, which would copy megabytes."""
        parts, definitions = self.parts, self.definitions
        if base != self.base:
            if base == self.first:
                old = [schema for schema in self.schemas if schema not in definitions]
                definitions = old + definitions
            parts = list(parts)
            parts[::2] = [_mcap.renumber(head, self.base - base) for head in parts[::2]]
        lead, body = b"".join(definitions), b"".join(parts)
        size = len(lead) + len(body)
        crc = crc32(body, crc32(lead))
        head = _mcap.encode_plain_chunk_head(size, crc, self.first_ns, self.last_ns)
        return head + lead, body, _mcap.encode_mark(self.first, self.following, mark_seed)


class GroupBuilder:
    """Collects the events of one segment into groups of the size and age that the policy sets."""

    def __init__(self, base: Offset, policy: FsyncPolicy) -> None:
        self._base = base
        self.next_offset = base
        self._first = base
        self._interval_ns = policy.interval_ns
        self._max_events = min(policy.max_events, _mcap.MAX_MESSAGES)
        self._max_bytes = min(policy.max_bytes, _mcap.MAX_GROUP_BYTES)
        self._channels: dict[_ChannelKey, Channel] = {}
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._schema_records: dict[int, bytes] = {}
        self.definition_bytes = 0
        """Bytes of all schemas and channels of the segment so far."""
        self._begin()

    def _begin(self) -> None:
        self._ids: dict[_ChannelKey, int] = {}  # of the channels that lead this group
        self._leading_schemas: set[int] = set()
        self._leading_bytes = 0
        self._definitions: list[bytes] = []
        self._parts: list[bytes] = []
        self._bytes = 0
        self._first_ns = self._last_ns = 0
        self._since_ns = 0

    @property
    def waiting(self) -> int:
        """Events in the group so far."""
        return self.next_offset - self._first

    @property
    def channels(self) -> int:
        """Channels of the segment so far: one for each key and version, or topic and format."""
        return len(self._channels)

    def add(self, events: Sequence[NewEvent], start: int) -> int:
        """Add events from index ``start`` on until the group is full; returns how many."""
        if not self._parts:
            self._since_ns = time.monotonic_ns()
            self._first_ns = self._last_ns = events[start].logged_ns
        room = self._max_events - self.waiting
        sequence = self.next_offset - self._base
        ids, size = self._ids, self._bytes
        first_ns, last_ns = self._first_ns, self._last_ns
        parts: list[bytes] = []
        for event in islice(events, start, start + room):
            which = event.key, event.version, event.format
            channel = ids.get(which) or self._add_channel(*which)
            payload, logged_ns = event.payload, event.logged_ns
            length = len(payload)
            head = encode_message_head(channel, sequence, logged_ns, event.stamp_ns, length)
            parts += (head, payload)
            sequence += 1
            if logged_ns < first_ns:
                first_ns = logged_ns
            elif logged_ns > last_ns:
                last_ns = logged_ns
            size += MESSAGE_HEAD + length
            if size >= self._max_bytes or self._leading_bytes >= MAX_LEADING_BYTES:
                break
        # Stored at the end only: an interrupt in the loop leaves the group unchanged.
        self._parts += parts
        self._first_ns, self._last_ns = first_ns, last_ns
        self._bytes = size
        self.next_offset = Offset(self._base + sequence)
        return len(parts) // 2

    def _add_channel(self, key: str, version: int, form: MessageFormat | None) -> int:
        """Id of an event's channel, whose record is put before the group's messages.

        Every chunk holds the records of its channels, so that it can be read without any other.
        The schema of an envelope or of our own event, which follows from the key, is written once a
        segment, that of verbatim messages in every chunk.
        """
        known = self._channels.get((key, version, form))
        if known is None:
            known = self._channels[key, version, form] = self._define(key, version, form)
            self.definition_bytes += len(_mcap.encode(known))
        if form is not None and known.schema_id != NO_SCHEMA:
            self._lead_schema(known.schema_id)
        self._lead(_mcap.encode(known))
        self._ids[key, version, form] = known.id
        return known.id

    def _lead_schema(self, schema: int) -> None:
        """Put a schema before the group's messages, unless it is there."""
        if schema not in self._leading_schemas:
            self._leading_schemas.add(schema)
            self._lead(self._schema_records[schema])

    def _lead(self, record: bytes) -> None:
        self._definitions.append(record)
        self._leading_bytes += len(record)

    def _define(self, key: str, version: int, form: MessageFormat | None) -> Channel:
        number = len(self._channels) + 1
        if form is None:
            name, text = schema_of(key)
            return key_channel(number, self._schema(name, "jsonschema", text), key, version)
        schema = NO_SCHEMA
        if form.schema:
            schema = self._schema(form.schema, form.schema_encoding, form.schema_text)
        return verbatim_channel(number, schema, key, form.encoding)

    def _schema(self, name: str, encoding: str, text: bytes) -> int:
        """The id of a schema, whose record is put before the group's messages if it is new."""
        schema = self._schemas.get((name, encoding, text))
        if schema is None:
            schema = self._schemas[name, encoding, text] = len(self._schemas) + 1
            record = _mcap.encode(Schema(id=schema, name=name, encoding=encoding, data=text))
            self._schema_records[schema] = record
            self.definition_bytes += len(record)
            self._lead_schema(schema)
        return schema

    def due(self) -> bool:
        """Whether a commit is due by the fsync policy."""
        return self.waiting > 0 and (
            self.waiting >= self._max_events
            or self._bytes >= self._max_bytes
            or self._leading_bytes >= MAX_LEADING_BYTES
            or time.monotonic_ns() - self._since_ns >= self._interval_ns
        )

    def finish(self) -> Group:
        """The group so far; the next event begins another."""
        group = Group(
            self._base,
            self._first,
            self.next_offset,
            self._first_ns,
            self._last_ns,
            self._definitions,
            self._parts,
            list(self._schema_records.values()),
        )
        self._first = self.next_offset
        self._begin()
        return group
