"""From when to when a log's robots say its events happened.

mapfold's own events are stamped when we wrote them, which for a log imported today is months after
the run, so they do not count. A sealed segment names the bounds of all its stamps: exact where it
has no event of ours. Else its chunks are read if that could still move the answer; mostly it
cannot, for the segments around it are exact.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

from eventsrc.errors import LogDamaged
from eventsrc.system_events import is_system_key

from . import _mcap
from ._mcap import Channel
from ._naming import SegmentPath
from ._sealed_file import SealedFile
from .reader import LogReader, OpenSegment


@dataclass(slots=True)
class RobotStamps:
    """Stamps of robots' events in int nanoseconds: ``first`` and ``last``, None while there are
    none."""

    first: int | None = None
    last: int | None = None
    _doubtful: list[tuple[int, int, SegmentPath]] = field(default_factory=list)

    def take(self, stamp_ns: int) -> None:
        """The stamp of one robot's event."""
        self.first = stamp_ns if self.first is None else min(self.first, stamp_ns)
        self.last = stamp_ns if self.last is None else max(self.last, stamp_ns)

    def take_sealed(self, entry: SegmentPath, segment: SealedFile) -> None:
        """The bounds that a sealed segment names."""
        first, last = segment.first_stamp_ns, segment.last_stamp_ns
        if _holds_ours(segment):
            self._doubtful.append((first, last, entry))
        else:
            self.take(first)
            self.take(last)

    def settle(self, reader: LogReader) -> None:
        """Read the segments that leave it open, as far as they can be read."""
        for first, last, entry in sorted(self._doubtful, key=lambda d: d[1], reverse=True):
            if self.first is None or self.last is None or first < self.first or last > self.last:
                for stamp_ns in _stamps(reader.open_segment(entry)):
                    self.take(stamp_ns)


def robots_of(channels: dict[int, Channel]) -> set[int]:
    """The ids of the channels that are not mapfold's own."""
    return {id_ for id_, channel in channels.items() if not is_system_key(channel.topic)}


def _holds_ours(segment: SealedFile) -> bool:
    robots = robots_of(segment.channels)
    counts = segment.statistics.channel_message_counts
    return any(count and channel not in robots for channel, count in counts.items())


def _stamps(segment: OpenSegment) -> Iterator[int]:
    for chunk in segment.chunks:
        try:
            body = segment.read_chunk(chunk)
        except LogDamaged:  # whoever reads the events will be told
            continue
        robots = robots_of(segment.channels_of(body))
        for channel, _, _, stamp_ns, _, _ in _mcap.walk(body):
            if channel in robots:
                yield stamp_ns
