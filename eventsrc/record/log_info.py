"""Facts about a log (`mapfold log info`), counted from the indexes of its segments.

First and last stamp are those of envelopes: mapfold's own events are stamped when they were
written, which for a correction may be months after the run, and verbatim messages by clocks of
their own. A sealed segment has the first and last of all its stamps, which is exact if it has
envelopes only. The chunks of any other are read only if its stamps reach beyond those found so far;
mostly they do not, because the segments before and behind it have earlier and later stamps.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from eventsrc.base.errors import LogDamaged
from eventsrc.base.text import advised
from eventsrc.envelope.gaps import gap_of
from eventsrc.envelope.model import FIRST_OFFSET, Offset
from eventsrc.envelope.system_events import LOSS_KEY, REJECTED_KEY
from eventsrc.log import LogReader
from eventsrc.log import mcap_records as _mcap
from eventsrc.log.archive_place import archive_place
from eventsrc.log.channels import carries_envelopes
from eventsrc.log.format import BEGUN, IMPORTED, SegmentPath
from eventsrc.log.mcap_records import Channel
from eventsrc.log.reader import OpenSegment
from eventsrc.log.sealed_segment import AwayFile, SealedFile
from eventsrc.log.segment import ActiveFile, formats_of

from .gap_history import ledger_of, loss_of


@dataclass(frozen=True, slots=True)
class SegmentInfo:
    """One segment: the number of its durable ``events`` and the ``size_bytes`` of its file.

    ``begun_ns`` is when it was begun, by the clock of the machine that wrote it; None after a
    recovery that could not read it. In an ``imported`` one the log times are those of the drive.
    One that is ``away`` is in the archive only.
    """

    name: str
    base: Offset
    events: int
    size_bytes: int
    sealed: bool
    begun_ns: int | None
    imported: bool
    away: bool = False


@dataclass(frozen=True, slots=True)
class LogInfo:
    """Counts and time bounds of a log.

    Times are int nanoseconds, earliest and latest whatever their order in the log, None while it is
    empty; stamps are those of envelopes. ``lost`` is the number of messages, keyframes and events
    that the log reports as lost, less the keyframes that came late. ``formats`` are the encodings
    and schemas of verbatim messages, by topic.
    """

    log_id: str
    path: Path
    events: int
    size_bytes: int
    segments: tuple[SegmentInfo, ...]
    keys: dict[str, int]
    rejected: int
    lost: int
    first_logged_ns: int | None
    last_logged_ns: int | None
    first_stamp_ns: int | None
    last_stamp_ns: int | None
    formats: dict[str, tuple[str, ...]] = field(default_factory=dict)
    archive: str | None = None
    """The URL at which the log was archived last."""


@dataclass(slots=True)
class _RobotStamps:
    """The bounds of the stamps of envelopes in int nanoseconds: ``first`` and ``last``, None while
    there are none."""

    first: int | None = None
    last: int | None = None
    _doubtful: list[tuple[int, int, SegmentPath]] = field(default_factory=list)

    def add(self, stamp_ns: int) -> None:
        """Add the stamp of one envelope."""
        self.first = stamp_ns if self.first is None else min(self.first, stamp_ns)
        self.last = stamp_ns if self.last is None else max(self.last, stamp_ns)

    def add_sealed(self, entry: SegmentPath, segment: SealedFile) -> None:
        """Add the stamp bounds of a sealed segment; keep it for `read_doubtful` if it has other
        events too."""
        first, last = segment.first_stamp_ns, segment.last_stamp_ns
        if _has_other_events(segment):
            self._doubtful.append((first, last, entry))
        else:
            self.add(first)
            self.add(last)

    def read_doubtful(self, reader: LogReader) -> None:
        """Read the segments with other events whose stamps reach beyond the bounds."""
        unread = []
        for doubtful in sorted(self._doubtful, key=lambda d: d[1], reverse=True):
            if self.last is None or doubtful[1] > self.last:
                self._read(reader, doubtful[2])
            else:
                unread.append(doubtful)
        for first, _, entry in sorted(unread, key=lambda d: d[0]):
            if self.first is None or first < self.first:
                self._read(reader, entry)

    def _read(self, reader: LogReader, entry: SegmentPath) -> None:
        for stamp_ns in _stamps(reader.open_segment(entry)):
            self.add(stamp_ns)


@dataclass(slots=True)
class _Tally:
    keys: Counter[str]
    logged: list[int]
    stamps: _RobotStamps
    formats: dict[str, set[str]]


def log_info(path: Path, *, note: Callable[[str], None] | None = None) -> LogInfo:
    """Count a log. Raises LogNotFound, NotALog or LogDamaged. ``note`` gets a line if a saved gap
    ledger is not used, with the reason."""
    tally = _Tally(Counter(), [], _RobotStamps(), {})
    with LogReader(path) as reader:
        segments = tuple(_count(reader, entry, tally) for entry in reader.segments)
        if note is not None:
            _note_missing(reader, segments, note)
        tally.stamps.read_doubtful(reader)
        return LogInfo(
            log_id=reader.log_id,
            path=path,
            events=reader.next_offset,
            size_bytes=sum(s.size_bytes for s in segments),
            segments=segments,
            keys={key: tally.keys[key] for key in sorted(tally.keys)},
            rejected=tally.keys[REJECTED_KEY],
            lost=_count_lost(reader, note) if tally.keys[LOSS_KEY] else 0,
            first_logged_ns=min(tally.logged, default=None),
            last_logged_ns=max(tally.logged, default=None),
            first_stamp_ns=tally.stamps.first,
            last_stamp_ns=tally.stamps.last,
            formats={key: tuple(sorted(tally.formats[key])) for key in sorted(tally.formats)},
            archive=None if (place := archive_place(path)) is None else place.url,
        )


def _note_missing(
    reader: LogReader, segments: tuple[SegmentInfo, ...], note: Callable[[str], None]
) -> None:
    """Note the offsets between segments: of segments that were deleted."""
    expected = FIRST_OFFSET
    for segment in segments:
        if segment.base > expected:
            note(
                f"{reader.path}: offsets {expected} to {segment.base - 1} are missing before "
                f"{segment.name}; run `{advised('log', 'verify', reader.path)}`"
            )
        expected = Offset(segment.base + segment.events)


def _count(reader: LogReader, entry: SegmentPath, tally: _Tally) -> SegmentInfo:
    segment = reader.open_segment(entry)
    if isinstance(segment, SealedFile):
        _count_sealed(segment, tally)
        tally.stamps.add_sealed(entry, segment)
    else:
        _count_growing(segment, tally)
    return SegmentInfo(
        name=segment.path.name,
        base=segment.base,
        events=segment.next_offset - segment.base,
        size_bytes=segment.size(),
        sealed=isinstance(segment, SealedFile),
        begun_ns=int(segment.head[BEGUN]) if BEGUN in segment.head else None,
        imported=IMPORTED in segment.head,
        away=isinstance(segment, AwayFile),
    )


def _count_sealed(segment: SealedFile, tally: _Tally) -> None:
    statistics = segment.statistics
    for channel, count in statistics.channel_message_counts.items():
        tally.keys[segment.channels[channel].topic] += count
    _add_formats(tally, segment, b"")
    tally.logged += (statistics.message_start_time, statistics.message_end_time)


def _count_growing(segment: ActiveFile, tally: _Tally) -> None:
    for chunk in segment.chunks:
        body = segment.read_chunk(chunk)
        channels = segment.channels_of(body)
        _add_formats(tally, segment, body)
        robot_channels = _robot_channels(channels)
        for channel, _, log_ns, stamp_ns, _, _ in _mcap.iter_messages(body):
            tally.keys[channels[channel].topic] += 1
            tally.logged.append(log_ns)
            if channel in robot_channels:
                tally.stamps.add(stamp_ns)


def _add_formats(tally: _Tally, segment: OpenSegment, body: bytes) -> None:
    """Add the formats of the verbatim messages that ``segment`` has in a chunk of this body."""
    channels = segment.channels_of(body)
    for id_, form in formats_of(channels, lambda: segment.schemas_of(body)).items():
        text = f"{form.encoding} {form.schema}".rstrip()
        tally.formats.setdefault(channels[id_].topic, set()).add(text)


def _count_lost(reader: LogReader, note: Callable[[str], None] | None = None) -> int:
    """`LogInfo.lost`: the sum of all reported losses, less the keyframes that came late.

    Gaps of keyframes are counted from the gap ledger, because late keyframes may have filled them.
    """
    losses = [
        loss for event in reader.read(keys={LOSS_KEY}) if (loss := loss_of(event)) is not None
    ]
    others = [loss.count for loss in losses if gap_of(loss) is None]
    if len(others) == len(losses):
        return sum(others)
    return sum(others) + ledger_of(reader, note=note).missing_reported()


def _robot_channels(channels: dict[int, Channel]) -> set[int]:
    """The ids of the channels with envelopes."""
    return {id_ for id_, channel in channels.items() if carries_envelopes(channel)}


def _has_other_events(segment: SealedFile) -> bool:
    robot_channels = _robot_channels(segment.channels)
    counts = segment.statistics.channel_message_counts
    return any(count and channel not in robot_channels for channel, count in counts.items())


def _stamps(segment: OpenSegment) -> Iterator[int]:
    for chunk in segment.chunks:
        try:
            body = segment.read_chunk(chunk)
        except LogDamaged:  # reported when the events are read
            continue
        robot_channels = _robot_channels(segment.channels_of(body))
        for channel, _, _, stamp_ns, _, _ in _mcap.iter_messages(body):
            if channel in robot_channels:
                yield stamp_ns
