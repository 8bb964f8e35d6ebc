"""Parsing events of a log for a fold: validate, decode vectors, and make unit vectors of them.

Parsing an event does not depend on earlier ones, so several processes can share the work.
"""

import sys
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from itertools import islice
from typing import NamedTuple

from eventsrc.base.errors import LogDamaged
from eventsrc.envelope.forms import read_envelopes
from eventsrc.envelope.ingest import Accepted, Rejected
from eventsrc.envelope.model import Offset
from eventsrc.envelope.occupancy_map import InvalidMap, OccupancyMap, decode_map
from eventsrc.envelope.system_events import MAP_KEY
from eventsrc.log import Event
from projections.fold.exact import Units, unit_vectors

READ_AHEAD = 16
"""Events validated together in a bulk fold: their 50 vectors or so fit a core's cache."""


class ParsedEvent(NamedTuple):
    """A validated event: ``parsed`` is None for mapfold's own events other than maps.

    ``units`` are the unit vectors of the envelope's detections, in order; empty if it was rejected.
    """

    offset: Offset
    logged_ns: int
    parsed: Accepted | OccupancyMap | Rejected | None
    units: list[Units | None]


def parse_events(events: Sequence[Event]) -> list[ParsedEvent]:
    """Validate events; for sixteen or so together this is quicker than one by one."""
    enveloped = [event for event in events if event.is_envelope]
    if not enveloped:
        return [ParsedEvent(e.offset, e.logged_ns, _parse_own(e), []) for e in events]
    # No size limit: it applied when the event was recorded.
    outcomes = read_envelopes(enveloped, max_bytes=sys.maxsize)
    units = iter(unit_vectors([v for a in outcomes if isinstance(a, Accepted) for v in a.vectors]))
    coming, parsed_events = iter(outcomes), []
    for event in events:
        parsed = next(coming) if event.is_envelope else _parse_own(event)
        count = len(parsed.vectors) if isinstance(parsed, Accepted) else 0
        parsed_events.append(
            ParsedEvent(event.offset, event.logged_ns, parsed, list(islice(units, count)))
        )
    return parsed_events


def parsed_stretches(
    events: Iterable[Event], ahead: int = READ_AHEAD
) -> Iterator[list[ParsedEvent]]:
    """`parse_events` of every ``ahead`` events. What precedes damage is yielded before LogDamaged
    is raised."""
    stretch: list[Event] = []
    try:
        for event in events:
            stretch.append(event)
            if len(stretch) == ahead:
                yield parse_events(stretch)
                stretch = []
    except LogDamaged:
        if stretch:
            yield parse_events(stretch)
        raise
    if stretch:
        yield parse_events(stretch)


def _parse_own(event: Event) -> OccupancyMap | Rejected | None:
    """An event that is no envelope: a map, or None for one that a fold passes over."""
    return parse_map(event.payload) if event.key == MAP_KEY else None


def parse_map(payload: bytes) -> OccupancyMap | Rejected:
    """The map of an event on `MAP_KEY`."""
    try:
        return _decoded(payload)
    except InvalidMap as error:
        return Rejected(f"it is on {MAP_KEY} and no map: {error}")


_decoded = lru_cache(maxsize=1)(decode_map)
"""Map servers publish the same map again and again: its image is then decoded once."""
