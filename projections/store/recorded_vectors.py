"""The vectors of a map's observations, read from the log: a history holds only their checksums."""

from collections.abc import Iterator, Sequence
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from eventsrc.base.crc import crc32
from eventsrc.base.errors import LogError
from eventsrc.envelope.ingest import Accepted
from eventsrc.envelope.model import Offset
from eventsrc.log import Event, LogReader
from projections.fold.exact import Units
from projections.map.own_events import vectors_of
from projections.map.parsing import READ_AHEAD, parse_events

from .history import History

_Vectors = NDArray[np.int32]


class RecordedVectors:
    """The unit vectors of the observations of a history of this log; for many threads."""

    def __init__(self, reader: LogReader, history: History) -> None:
        self._log, self._log_id = reader.path, reader.log_id
        self._history = history

    def of(self, observations: NDArray[np.int64]) -> _Vectors:
        """The vectors of these observations, which have one, in units of 2⁻²⁰, shape (n, dim).

        Raises LogError if the log has them no more.
        """
        tables = self._history.tables
        order = np.argsort(observations, kind="stable")
        asked = observations[order]
        offsets = tables.integers("observation", "offset")[asked]
        crcs = tables.integers("observation", "crc")[asked].tolist()
        events, starts = np.unique(offsets, return_index=True)
        ends = [*starts[1:].tolist(), len(asked)]
        found: _Vectors = np.zeros((len(asked), 0), np.int32)
        # With a reader of its own: a map may be asked after its log was closed.
        with LogReader(self._log) as reader:
            units = self._units(reader, events) if len(events) else iter(())
            for event, first, last in zip(events.tolist(), starts.tolist(), ends, strict=True):
                of_event = next(units, {})
                for row in range(first, last):
                    unit = of_event.get(crcs[row])
                    if unit is None:
                        raise LogError(
                            f"the log at {self._log} has other vectors at offset {event} than its"
                            " history; open it again"
                        )
                    if not found.shape[1]:
                        found = np.empty((len(asked), len(unit)), np.int32)
                    found[order[row]] = unit
        return found

    def _units(self, reader: LogReader, events: NDArray[np.int64]) -> Iterator[dict[int, _Vectors]]:
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

    def _read(self, reader: LogReader, events: NDArray[np.int64]) -> Iterator[Event]:
        if reader.log_id != self._log_id:
            return
        numbers = events.tolist()
        wanted = set(numbers)
        for event in reader.read(Offset(numbers[0]), Offset(numbers[-1] + 1)):
            if event.offset in wanted:
                yield event
