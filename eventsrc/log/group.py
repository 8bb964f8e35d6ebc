"""The next commit while it is still in memory: events in, one group out.

A *group* is what one commit brings to the disk: an uncompressed chunk and its commit mark. Taking
events costs no more than laying out their heads; joining the bytes and their CRC are left to
`Group.pieces`, which may run in another thread.
"""

import time
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice

from eventsrc.envelope import Offset

from . import mcap_records as _mcap
from .durable_files import FsyncPolicy
from .event import NewEvent
from .format import key_channel, schema_of
from .mcap_records import MESSAGE_HEAD, Channel, Schema, encode_message_head


@dataclass(frozen=True, slots=True)
class Group:
    """Offsets ``first`` to before ``following``, and the records that hold them. ``parts`` are the
    head and the payload of each message by turns; the heads count from offset ``base``.
    ``definitions`` hold the schemas that are new in it; ``schemas`` are all so far, for a file that
    does not have those before."""

    base: Offset
    first: Offset
    following: Offset
    first_ns: int
    last_ns: int
    definitions: list[bytes]
    parts: list[bytes]
    schemas: list[bytes]

    def pieces(self, base: Offset, mark_seed: int) -> tuple[bytes, bytes, bytes]:
        """What to write into a file that begins at offset ``base`` and has that mark seed, in this
        order: the chunk's head, its messages, its commit mark. The first two are not joined, for
        the messages are megabytes."""
        parts, definitions = self.parts, self.definitions
        if base != self.base:
            if base == self.first:
                old = [schema for schema in self.schemas if schema not in definitions]
                definitions = old + definitions
            parts = list(parts)
            parts[::2] = [_mcap.renumbered(head, self.base - base) for head in parts[::2]]
        lead, body = b"".join(definitions), b"".join(parts)
        size = len(lead) + len(body)
        crc = zlib.crc32(body, zlib.crc32(lead))
        head = _mcap.encode_plain_chunk_head(size, crc, self.first_ns, self.last_ns)
        return head + lead, body, _mcap.encode_mark(self.first, self.following, mark_seed)


class GroupBuilder:
    """Takes events of one segment and cuts them into groups as the policy says.

    With a ``slack`` above 1 a group may grow to that many times the policy's events and bytes, for
    a caller whose last group is still on its way to the disk.
    """

    def __init__(self, base: Offset, policy: FsyncPolicy, slack: int = 1) -> None:
        self._base = base
        self.next_offset = base
        self._first = base
        self._policy = policy
        self._most_events = min(policy.max_events * slack, _mcap.MAX_MESSAGES)
        self._most_bytes = min(policy.max_bytes * slack, _mcap.MAX_GROUP_BYTES)
        self._channels: dict[tuple[str, int], Channel] = {}
        self._schemas: dict[str, int] = {}
        self._schema_records: list[bytes] = []
        self._begin()

    def _begin(self) -> None:
        self._ids: dict[tuple[str, int], int] = {}
        """Of the channels whose records lead this group."""
        self._definitions: list[bytes] = []
        self._parts: list[bytes] = []
        self._bytes = 0
        self._first_ns = self._last_ns = 0
        self._since_ns = 0

    @property
    def waiting(self) -> int:
        """Events taken and not cut."""
        return self.next_offset - self._first

    @property
    def channels(self) -> int:
        """Keys, each of one version, that were taken so far."""
        return len(self._channels)

    def take(self, events: Sequence[NewEvent], start: int) -> int:
        """Take events from index ``start`` on until the group is full; how many were taken."""
        if not self._parts:
            self._since_ns = time.monotonic_ns()
            self._first_ns = self._last_ns = events[start].logged_ns
        room = self._most_events - self.waiting
        sequence = self.next_offset - self._base
        ids, size = self._ids, self._bytes
        first_ns, last_ns = self._first_ns, self._last_ns
        parts: list[bytes] = []
        for key, payload, logged_ns, stamp_ns, version in islice(events, start, start + room):
            channel = ids.get((key, version)) or self._lead_with(key, version)
            length = len(payload)
            parts.append(encode_message_head(channel, sequence, logged_ns, stamp_ns, length))
            parts.append(payload)
            sequence += 1
            if logged_ns < first_ns:
                first_ns = logged_ns
            elif logged_ns > last_ns:
                last_ns = logged_ns
            size += MESSAGE_HEAD + length
            if size >= self._most_bytes:
                break
        # All at the end: an interrupt in the loop leaves everything as it was.
        self._parts += parts
        self._first_ns, self._last_ns = first_ns, last_ns
        self._bytes = size
        self.next_offset = Offset(self._base + sequence)
        return len(parts) // 2

    def _lead_with(self, key: str, version: int) -> int:
        """The channel's id. Its record leads every chunk that uses it, so that no rot in one chunk
        can take the names from another's events; the schema, which the key tells, stands once."""
        known = self._channels.get((key, version))
        if known is None:
            known = self._channels[key, version] = self._define(key, version)
        self._definitions.append(_mcap.encode(known))
        self._ids[key, version] = known.id
        return known.id

    def _define(self, key: str, version: int) -> Channel:
        name, text = schema_of(key)
        schema = self._schemas.get(name)
        if schema is None:
            schema = self._schemas[name] = len(self._schemas) + 1
            record = Schema(id=schema, name=name, encoding="jsonschema", data=text)
            self._schema_records.append(_mcap.encode(record))
            self._definitions.append(self._schema_records[-1])
        return key_channel(len(self._channels) + 1, schema, key, version)

    def due(self) -> bool:
        """True when the policy wants a commit now."""
        policy = self._policy
        return self.waiting > 0 and (
            self.full()
            or self.waiting >= policy.max_events
            or self._bytes >= policy.max_bytes
            or time.monotonic_ns() - self._since_ns >= policy.interval_ns
        )

    def full(self) -> bool:
        """True when there is no room for another event."""
        return self.waiting >= self._most_events or self._bytes >= self._most_bytes

    def cut(self) -> Group:
        """What was taken since the last cut, as one group."""
        group = Group(
            self._base,
            self._first,
            self.next_offset,
            self._first_ns,
            self._last_ns,
            self._definitions,
            self._parts,
            list(self._schema_records),
        )
        self._first = self.next_offset
        self._begin()
        return group
