"""Steps of a recovery: rename every segment file by the base offset in its head; write a new sealed
segment from the good chunks of a damaged one.

Log id and base in the head of a segment identify its log and its offsets. Its name may be wrong,
because people copy, restore and rename files. The rules:

* A segment of another log is set aside as ``….foreign-LOG_ID``. Which log this is says
  `own_log_id`: usually that of most files.
* A segment under a wrong name is renamed.
* Of several files with the same base the one with the most good events stays; the others are set
  aside as ``….duplicate``.
* A file with a damaged head keeps its name, unless another file claims it: then it is set aside as
  ``….damaged``.
* A folder, pipe or device with the name of a segment is set aside as ``….damaged``.
* With an MCAP file that another program wrote, without our metadata, nothing is done at all.

Nothing is deleted. A file is renamed in two steps, by way of ``….misnamed``; a recovery that was
interrupted between them goes on from there.

Every offset is kept, because checkpoints, maps and people refer to offsets: a lost event is
replaced by a ``mapfold/loss`` event with cause ``rot``. Timestamps of lost events are estimated
from their neighbours: those of the event before, or else of the one after.
"""

import os
import re
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

from eventsrc.base.errors import LogDamaged, NotALog
from eventsrc.base.text import advised, visible
from eventsrc.envelope.model import ENVELOPE_VERSION, Offset
from eventsrc.envelope.system_events import LOSS_KEY, Loss

from . import format as names
from . import mcap_records as _mcap
from .channels import NO_SCHEMA, is_verbatim, key_channel, schema_of
from .durable_files import sync_directory
from .log_identity import CarriedId, own_log_id
from .mcap_records import Channel, Schema
from .scan import read_body, scan_active, scan_sealed
from .seal import SegmentPlan, seal
from .sealed_segment import SealedFile, check_sealed
from .segment import ActiveFile, ChunkRef, Scan

_FILE_NAME: Final = re.compile(r"[A-Za-z0-9_-]{1,64}")


@dataclass(frozen=True, slots=True)
class Moved:
    """A renamed file: old name, new name, and why."""

    name: str
    now: str
    reason: str


@dataclass(frozen=True, slots=True)
class _SegmentFile:
    """``target`` is the segment that the file is by its head, or by its name if the head cannot be
    read (``log_id`` is None then)."""

    path: Path
    target: names.SegmentPath
    log_id: str | None


def quarantine(path: Path, suffix: str, reason: str) -> Moved:
    """Take a file out of the log: rename it to a free name with ``suffix``."""
    aside = names.free_name(path, suffix)
    path.rename(aside)
    sync_directory(path.parent)
    return Moved(path.name, aside.name, reason)


class RenamedSegments(NamedTuple):
    """The result of `rewrite_segments`; ``log_id`` is None if no head could be read."""

    log_id: str | None
    moved: list[Moved]


def rewrite_segments(log: Path, noted: str | None) -> RenamedSegments:
    """Set aside and rename segment files, holding the writer lock; ``noted`` is the log id in
    `sealed_end`. Raises LogDamaged, with nothing done, for MCAP files of other programs."""
    files = [_inspect(segment.path, segment) for segment in names.segment_files(log)]
    files += [_inspect(path, _target_of(path)) for path in names.half_renamed(log)]
    log_id = own_log_id((c for f in files if (c := _carried(f)) is not None), noted)
    moved = [quarantine(path, names.DAMAGED, "it is no file") for path in names.not_files(log)]
    by_base: defaultdict[Offset, list[_SegmentFile]] = defaultdict(list)
    for file in files:
        if file.log_id in (None, log_id):
            by_base[file.target.base].append(file)
    for file in files:
        if file.log_id not in (None, log_id):
            reason = f"it belongs to log {file.log_id}, not {log_id}"
            moved.append(quarantine(file.path, _foreign_suffix(file.log_id), visible(reason)))
    bases = sorted(by_base)
    for base, following in zip(bases, [*bases[1:], None], strict=False):
        moved += _keep_best(by_base[base], following)
    moved += _rename(log, [same_base[0] for same_base in by_base.values()])
    return RenamedSegments(log_id, moved)


def _keep_best(files: list[_SegmentFile], following: Offset | None) -> Iterator[Moved]:
    """Sort ``files``, which have the same base, best first; set the others aside."""
    if len(files) == 1 or _still_being_sealed(files):
        files.sort(key=lambda file: not file.target.sealed)
        return
    files.sort(key=lambda file: _rank(file, following), reverse=True)
    for file in files[1:]:
        if file.log_id is None:
            reason = "its head is damaged, and another file is this segment"
            yield quarantine(file.path, names.DAMAGED, reason)
        else:
            reason = f"{files[0].target.path.name} holds the same offsets"
            yield quarantine(file.path, names.DUPLICATE, reason)


def _rename(log: Path, files: list[_SegmentFile]) -> list[Moved]:
    moved: list[Moved] = []
    for file in [f for f in files if f.path != f.target.path]:
        if not file.path.name.startswith(file.target.path.name + names.MISNAMED):
            file.path.rename(names.free_name(file.target.path, names.MISNAMED))
        reason = f"its head says that it begins at offset {file.target.base}"
        moved.append(Moved(file.path.name, file.target.path.name, reason))
    sync_directory(log)
    for path in names.half_renamed(log):
        path.rename(_target_of(path).path)
    sync_directory(log)
    return moved


def _carried(file: _SegmentFile) -> CarriedId | None:
    if file.log_id is None:
        return None
    base = file.target.base
    return CarriedId(file.log_id, base, file.path.name.startswith(f"{base:020d}"))


def _foreign_suffix(log_id: str | None) -> str:
    """With the log id, if that can be part of a file's name: any program may have written it."""
    usable = log_id is not None and _FILE_NAME.fullmatch(log_id)
    return f"{names.FOREIGN}-{log_id}" if usable else names.FOREIGN


def _target_of(path: Path) -> names.SegmentPath:
    """The segment that a half-renamed file is to become."""
    name = path.name.partition(names.MISNAMED)[0]
    return names.SegmentPath(
        path.with_name(name), Offset(int(name[:20])), name.endswith(names.SEALED)
    )


def _inspect(path: Path, named: names.SegmentPath) -> _SegmentFile:
    try:
        claims = names.head_at_any_base(path)
    except LogDamaged:
        return _SegmentFile(path, named, None)
    except names.ForeignSegment as error:
        raise LogDamaged(_foreign_message(path, error)) from None
    except NotALog:
        return _SegmentFile(path, named, None)
    base, sealed = Offset(int(claims["base"])), names.PREVIOUS in claims
    where = names.segment_path(path.parent, base, names.SEALED if sealed else names.ACTIVE)
    return _SegmentFile(path, names.SegmentPath(where, base, sealed), claims["log_id"])


def _foreign_message(path: Path, error: names.ForeignSegment) -> str:
    log = path.parent
    return (
        f"{error}; nothing was changed. Put the original back, or move the file out of {log}, run "
        f"`{advised('log', 'recover', log)}` if other segments are there, and append what it holds "
        f"by `{advised('import', log, 'FILE')}`"
    )


def _still_being_sealed(files: list[_SegmentFile]) -> bool:
    """Whether these are a good sealed segment and the active one it was made from, left by a
    crash."""
    if {file.path.name for file in files} != {
        names.segment_path(file.path.parent, files[0].target.base, suffix).name
        for file in files
        for suffix in (names.SEALED, names.ACTIVE)
    }:
        return False
    sealed, active = sorted(files, key=lambda file: not file.target.sealed)
    if not sealed.target.sealed or active.target.sealed or check_sealed(sealed.path).fault:
        return False
    scan = _scan(active)
    return scan.next_offset <= _scan(sealed).next_offset


def _rank(file: _SegmentFile, following: Offset | None) -> tuple[int, bool, bool]:
    """Sort key: good events before the next segment; then the right name; then sealed."""
    events = sum(
        chunk.following - chunk.first
        for chunk in _scan(file).chunks
        if following is None or chunk.first < following
    )
    return events, file.path == file.target.path, file.target.sealed


def _scan(file: _SegmentFile) -> Scan:
    if file.target.sealed:
        return scan_sealed(file.path, file.target.base, None)
    return scan_active(file.path, file.target.base)


class EventTimes(NamedTuple):
    """Log time and stamp of an event, int nanoseconds."""

    logged_ns: int
    stamp_ns: int


UNKNOWN_TIMES = EventTimes(0, 0)


def first_and_last_times(body: bytes) -> tuple[EventTimes, EventTimes]:
    """The times of the first and the last event in the body of a good chunk."""
    times = [
        EventTimes(log_ns, stamp_ns) for _, _, log_ns, stamp_ns, _, _ in _mcap.iter_messages(body)
    ]
    return times[0], times[-1]


def adjacent_times(before: names.SegmentPath | None, after: names.SegmentPath | None) -> EventTimes:
    """The times of the event before a lost segment, or else of the one after it; zeros if neither
    can be read."""
    for segment, chunk, which in ((before, -1, 1), (after, 0, 0)):
        if segment is None:
            continue
        try:
            file = (SealedFile if segment.sealed else ActiveFile)(segment.path, segment.base)
            if file.chunks:
                return first_and_last_times(file.read_chunk(file.chunks[chunk]))[which]
        except (LogDamaged, NotALog):
            continue
    return UNKNOWN_TIMES


_BATCH = 4096
"""Losses encoded at a time."""
LOST_SCHEMA = "lost"
"""The name of a schema that no readable chunk has."""


@dataclass(slots=True)
class _Definitions:
    """Channels and schemas of the good chunks, and one channel for losses."""

    channels: dict[int, Channel] = field(default_factory=dict)
    schemas: dict[int, Schema] = field(default_factory=dict)

    def add(self, body: bytes) -> None:
        schemas, channels = _mcap.definitions(body)
        self.schemas.update((schema.id, schema) for schema in schemas)
        self.channels.update((channel.id, channel) for channel in channels)

    def loss_channel(self) -> int:
        for channel in self.channels.values():
            if channel.topic == LOSS_KEY:
                return channel.id
        id_ = max(self.channels, default=0) + 1
        schema = max([*self.schemas, *(c.schema_id for c in self.channels.values())], default=0) + 1
        self.channels[id_] = key_channel(id_, schema, LOSS_KEY, ENVELOPE_VERSION)
        return id_

    def encode(self) -> bytes:
        """All records, schemas first. A lost schema is generated again from its key; that of
        verbatim messages, lost with all chunks that had it, is left empty."""
        for channel in self.channels.values():
            if channel.schema_id in (NO_SCHEMA, *self.schemas):
                continue
            name, encoding, text = LOST_SCHEMA, "", b""
            if not is_verbatim(channel):
                (name, text), encoding = schema_of(channel.topic), "jsonschema"
            self.schemas[channel.schema_id] = Schema(
                id=channel.schema_id, name=name, encoding=encoding, data=text
            )
        return _mcap.encode_all([*self.schemas.values(), *self.channels.values()])


def rebuild_segment(plan: SegmentPlan, source: Path | None, scan: Scan, times: EventTimes) -> str:
    """Seal the good chunks of ``source``, with losses for the gaps; the new file's SHA-256. Losses
    have ``times`` if there is no good chunk to take them from."""
    if source is None:
        return seal(plan, _chunk_bodies(-1, scan, times))
    fd = os.open(source, os.O_RDONLY)
    try:
        return seal(plan, _chunk_bodies(fd, scan, times))
    finally:
        os.close(fd)


def _chunk_bodies(fd: int, scan: Scan, times: EventTimes) -> Iterator[bytes]:
    definitions = _Definitions(dict(scan.channels), dict(scan.schemas))
    for chunk in scan.chunks:
        definitions.add(read_body(fd, chunk))
    loss_channel = definitions.loss_channel() if scan.gaps else 0
    prelude = definitions.encode()
    if scan.chunks:
        times = first_and_last_times(read_body(fd, scan.chunks[0]))[0]
    pieces: list[tuple[int, ChunkRef | int]] = [(c.first, c) for c in scan.chunks]
    pieces += scan.gaps
    for first, rest in sorted(pieces, key=lambda piece: piece[0]):
        if isinstance(rest, ChunkRef):
            body = read_body(fd, rest)
            times = first_and_last_times(body)[1]
            yield prelude + body
            prelude = b""
        else:
            for start in range(first, rest + 1, _BATCH):
                upto = min(start + _BATCH, rest + 1)
                yield prelude + _losses(scan.base, loss_channel, start, upto, times)
                prelude = b""


def _losses(base: Offset, channel: int, first: int, following: int, times: EventTimes) -> bytes:
    parts: list[bytes] = []
    for offset in range(first, following):
        loss = Loss(publisher="log", first=offset, last=offset, count=1, cause="rot")
        payload = loss.model_dump_json().encode()
        head = _mcap.encode_message_head(
            channel, offset - base, times.logged_ns, times.stamp_ns, len(payload)
        )
        parts += (head, payload)
    return b"".join(parts)


def slice_scan(source: Path, scan: Scan, first: Offset, end: Offset) -> Scan:
    """The part of a scan of ``source`` from offset ``first`` to before ``end``, as a segment of its
    own that ends with the last good event."""
    rest = Scan(first, scan.log_id, next_offset=first, channels=scan.channels, schemas=scan.schemas)
    for chunk in scan.chunks:
        start, stop = max(first, chunk.first), min(end, chunk.following)
        if start < stop:
            body = partial(_slice_chunk, source, chunk, scan.base, range(start, stop), first)
            rest.add_chunk(ChunkRef(0, chunk.length, start, stop, body=body))
    return rest


def _slice_chunk(
    source: Path, chunk: ChunkRef, base: Offset, offsets: range, new_base: Offset
) -> bytes:
    """The messages of a chunk with these offsets, renumbered from ``new_base``."""
    fd = os.open(source, os.O_RDONLY)
    try:
        body = read_body(fd, chunk)
    finally:
        os.close(fd)
    schemas, channels = _mcap.definitions(body)
    parts = [_mcap.encode_all([*schemas, *channels])]
    for channel, sequence, log_ns, stamp_ns, at, end in _mcap.iter_messages(body):
        offset = base + sequence
        if offset in offsets:
            head = _mcap.encode_message_head(channel, offset - new_base, log_ns, stamp_ns, end - at)
            parts += (head, body[at:end])
    return b"".join(parts)
