"""When what is gone may have happened: as its neighbours did."""

from typing import NamedTuple

from eventsrc.errors import LogDamaged, NotALog

from . import _mcap
from ._active_file import ActiveFile
from ._naming import SegmentPath
from ._sealed_file import SealedFile


class Moment(NamedTuple):
    """The times of an event, int nanoseconds."""

    logged_ns: int
    stamp_ns: int


UNKNOWN = Moment(0, 0)


def moments(body: bytes) -> tuple[Moment, Moment]:
    """Those of the first and of the last event in the body of a good chunk."""
    times = [Moment(log_ns, stamp_ns) for _, _, log_ns, stamp_ns, _, _ in _mcap.walk(body)]
    return times[0], times[-1]


def moment_between(before: SegmentPath | None, behind: SegmentPath | None) -> Moment:
    """The time of the event before a lost segment, else of the one behind it, if either can be
    read."""
    for segment, chunk, which in ((before, -1, 1), (behind, 0, 0)):
        if segment is None:
            continue
        try:
            file = (SealedFile if segment.sealed else ActiveFile)(segment.path, segment.base)
            if file.chunks:
                return moments(file.read_chunk(file.chunks[chunk]))[which]
        except (LogDamaged, NotALog):
            continue
    return UNKNOWN
