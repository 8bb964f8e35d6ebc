"""The unit vectors of the observations of a history: from the cache beside the log, else from the
log.

The history has only their checksums, as most questions need no vectors. The first question that
compares all of them keeps them in parts of their own: the arrays of a stripe are the checksums and,
end to end, the vectors. A later question maps these files into memory, and reads from the log only
vectors that were recorded since.
"""

from collections.abc import Iterator, Sequence
from itertools import islice, pairwise
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from eventsrc.base.errors import LogError
from eventsrc.base.machine import crc32
from eventsrc.envelope.ingest import Accepted
from eventsrc.envelope.model import FIRST_OFFSET, Offset
from eventsrc.log import Event, LogReader
from projections.fold.exact import Units
from projections.map.parsing import READ_AHEAD, parse_events, vectors_of

from .columns import NONE, Stripe
from .history import History
from .tables import DamagedPart
from .timeline_cache import TimelineCache

MOST_VECTOR_BYTES: Final = 1024 * 1024 * 1024
"""The most bytes of vectors that are kept for one history, 4 for each component: those of the first
500,000 observations of 512 dimensions. Each question reads later ones from the log."""
_STRIPE_EVENTS: Final = 4_096
_Rows = NDArray[np.int64]
_Vectors = NDArray[np.int32]


class _Kept(NamedTuple):
    """``stripes`` have the vectors of the first observations that have one; ``bounds`` are the
    first observation of each stripe among these, and their number."""

    stripes: Sequence[Stripe] = ()
    bounds: tuple[int, ...] = (0,)

    @property
    def end(self) -> Offset:
        return self.stripes[-1].end if self.stripes else FIRST_OFFSET


class RecordedVectors:
    """The unit vectors of the observations of a history of this log; for many threads. Those of the
    first ``end`` events are kept in ``cache``, if there is one, when all of them are asked for."""

    def __init__(
        self, reader: LogReader, history: History, end: Offset, cache: TimelineCache | None
    ) -> None:
        self._log, self._log_id = reader.path, reader.log_id
        self._readable_end = reader.readable_end
        self._history, self._end, self._cache = history, end, cache
        crcs = history.tables.integers("observation", "crc")
        self._ordinals = np.flatnonzero(crcs != NONE)
        self._crcs = crcs[self._ordinals]
        self._offsets = history.tables.integers("observation", "offset")[self._ordinals]
        self._kept: _Kept | None = None

    def of(self, observations: _Rows) -> _Vectors:
        """The vectors of these observations, which have one, in units of 2⁻²⁰, shape (n, dim).

        Raises LogError if the log has them no more.
        """
        rows = np.searchsorted(self._ordinals, observations)
        try:
            if self._kept is None:
                self._kept = self._opened()
            return self._at(rows, self._kept)
        except DamagedPart as damage:
            if self._cache is not None:
                self._cache.forget(damage, "vectors")
            self._kept = _Kept()
            return self._at(rows, self._kept)

    def _opened(self) -> _Kept:
        """The stripes of the cache. Raises DamagedPart."""
        stripes = self._cache.stripes(self._readable_end, "vectors") if self._cache else []
        bounds = [0]
        for stripe in stripes:
            crcs = stripe.arrays["crc"]
            known = self._crcs[bounds[-1] : bounds[-1] + len(crcs)]
            if not np.array_equal(crcs[: len(known)], known):
                raise DamagedPart(f"the vectors from offset {stripe.start} on are of other events")
            bounds.append(bounds[-1] + len(crcs))
        return _Kept(stripes, tuple(bounds))

    def _at(self, rows: _Rows, kept: _Kept) -> _Vectors:
        """The vectors of the observations with these numbers among those that have one."""
        order = np.argsort(rows, kind="stable")
        asked = rows[order]
        splits = np.searchsorted(asked, kept.bounds).tolist()
        parts = [
            _vectors(stripe, asked[first:last] - bound)
            for stripe, bound, (first, last) in zip(
                kept.stripes, kept.bounds, pairwise(splits), strict=False
            )
            if first < last
        ]
        if (late := asked[splits[-1] :]).size:
            parts.append(self._from_log(late))
            if len(late) == np.searchsorted(self._offsets, self._end) - kept.bounds[-1]:
                self._keep(kept, parts[-1])
        if not parts:
            return np.zeros((0, 0), np.int32)
        found = parts[0] if len(parts) == 1 else np.concatenate(parts)
        return found if np.array_equal(asked, rows) else found[np.argsort(order)]

    def _keep(self, kept: _Kept, vectors: _Vectors) -> None:
        """Keep the vectors of the events from the end of those kept to ``end``."""
        first, count = kept.bounds[-1], MOST_VECTOR_BYTES // vectors[0].nbytes
        offsets = [*range(kept.end, self._end, _STRIPE_EVENTS), self._end]
        bounds = np.searchsorted(self._offsets, offsets).tolist()
        stripes = [
            Stripe(
                Offset(start),
                Offset(end),
                {},
                {"crc": self._crcs[a:b], "unit": vectors[a - first : b - first].ravel()},
            )
            for (start, end), (a, b) in zip(pairwise(offsets), pairwise(bounds), strict=True)
            if b <= count
        ]
        if self._cache is not None:
            self._cache.keep_vectors([*kept.stripes, *stripes], kept.end)

    def _from_log(self, rows: _Rows) -> _Vectors:
        """The vectors of these observations, given in order."""
        events, starts = np.unique(self._offsets[rows], return_index=True)
        crcs = self._crcs[rows].tolist()
        found: _Vectors = np.zeros((len(rows), 0), np.int32)
        # With a reader of its own: a map may be asked after its log was closed.
        with LogReader(self._log) as reader:
            units = self._units(reader, events)
            for event, first, last in zip(
                events.tolist(), starts.tolist(), [*starts[1:].tolist(), len(rows)], strict=True
            ):
                of_event = next(units, {})
                for row in range(first, last):
                    unit = of_event.get(crcs[row])
                    if unit is None:
                        raise LogError(
                            f"the log at {self._log} has other vectors at offset {event} than its"
                            " history; open it again"
                        )
                    if not found.shape[1]:
                        found = np.empty((len(rows), len(unit)), np.int32)
                    found[row] = unit
        return found

    def _units(self, reader: LogReader, events: _Rows) -> Iterator[dict[int, _Vectors]]:
        """For each of these events its vectors by checksum."""
        history = self._history
        added = vectors_of(reader, history.settings, history.corrections)
        wanted = self._read(reader, events)
        while stretch := list(islice(wanted, READ_AHEAD)):
            for event in parse_events(stretch):
                units: Sequence[Units | None] = event.units
                if isinstance(event.parsed, Accepted) and added is not None:
                    units = added.applied(event.parsed, units)[1]
                yield {crc32(unit[1].data): unit[1] for unit in units if unit is not None}

    def _read(self, reader: LogReader, events: _Rows) -> Iterator[Event]:
        if reader.log_id != self._log_id:
            return
        numbers = events.tolist()
        wanted = set(numbers)
        for event in reader.read(Offset(numbers[0]), Offset(numbers[-1] + 1)):
            if event.offset in wanted:
                yield event


def _vectors(stripe: Stripe, rows: _Rows) -> _Vectors:
    """Some vectors of a stripe, shape (n, dim)."""
    count = len(stripe.arrays["crc"])
    found = stripe.arrays["unit"].reshape(count, -1)
    return found if np.array_equal(rows, np.arange(count)) else found[rows]
