"""What `mapfold log info` tells: counted from the indexes, hardly reading any events."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from eventsrc.system_events import LOSS_KEY, REJECTED_KEY

from . import _mcap
from ._active_file import ActiveFile
from ._losses import count_lost
from ._naming import SegmentPath
from ._sealed_file import SealedFile
from ._stamps import RobotStamps, robots_of
from .reader import LogReader


@dataclass(frozen=True, slots=True)
class SegmentInfo:
    """One segment: ``events`` are the durable ones, ``size_bytes`` what the file takes."""

    name: str
    base: int
    events: int
    size_bytes: int
    sealed: bool


@dataclass(frozen=True, slots=True)
class LogInfo:
    """A log at a glance. Times are int nanoseconds, None while the log is empty; the first is the
    earliest and the last the latest, whatever their order in the log; stamps are those of the
    robots' events, not of our own. ``lost`` is what the log says was lost, less the keyframes that
    came late after all."""

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


@dataclass(slots=True)
class _Tally:
    keys: Counter[str]
    logged: list[int]
    stamps: RobotStamps


def log_info(path: Path, *, note: Callable[[str], None] | None = None) -> LogInfo:
    """Count a log. Raises LogNotFound, NotALog or LogDamaged. ``note`` takes a line for people: why
    a ledger saved beside the log is not used."""
    tally = _Tally(Counter(), [], RobotStamps())
    with LogReader(path) as reader:
        segments = tuple(_count(reader, entry, tally) for entry in reader.segments)
        tally.stamps.settle(reader)
        return LogInfo(
            log_id=reader.log_id,
            path=path,
            events=reader.next_offset,
            size_bytes=sum(s.size_bytes for s in segments),
            segments=segments,
            keys={key: tally.keys[key] for key in sorted(tally.keys)},
            rejected=tally.keys[REJECTED_KEY],
            lost=count_lost(reader, note) if tally.keys[LOSS_KEY] else 0,
            first_logged_ns=min(tally.logged, default=None),
            last_logged_ns=max(tally.logged, default=None),
            first_stamp_ns=tally.stamps.first,
            last_stamp_ns=tally.stamps.last,
        )


def _count(reader: LogReader, entry: SegmentPath, tally: _Tally) -> SegmentInfo:
    segment = reader.open_segment(entry)
    if isinstance(segment, SealedFile):
        _count_sealed(segment, tally)
        tally.stamps.take_sealed(entry, segment)
    else:
        _count_growing(segment, tally)
    return SegmentInfo(
        name=segment.path.name,
        base=segment.base,
        events=segment.next_offset - segment.base,
        size_bytes=segment.size(),
        sealed=isinstance(segment, SealedFile),
    )


def _count_sealed(segment: SealedFile, tally: _Tally) -> None:
    statistics = segment.statistics
    for channel, count in statistics.channel_message_counts.items():
        tally.keys[segment.channels[channel].topic] += count
    tally.logged += (statistics.message_start_time, statistics.message_end_time)


def _count_growing(segment: ActiveFile, tally: _Tally) -> None:
    for chunk in segment.chunks:
        body = segment.read_chunk(chunk)
        channels = segment.channels_of(body)
        robots = robots_of(channels)
        for channel, _, log_ns, stamp_ns, _, _ in _mcap.walk(body):
            tally.keys[channels[channel].topic] += 1
            tally.logged.append(log_ns)
            if channel in robots:
                tally.stamps.take(stamp_ns)
