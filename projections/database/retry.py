"""Trying parked events again.

An event that was parked changes, once it can be folded, everything that came after it; so there is
no writing it in later. If all parked events of a sink can be read now (by a newer mapfold), the
sink is rebuilt to where it was. If one still cannot, nothing is changed.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

from eventsrc.envelope import Offset
from eventsrc.ingest import Rejected
from eventsrc.log import LogReader
from eventsrc.upcast import read_envelope
from projections.settings import Settings

from . import checkpoints
from .checkpoints import DeadLetter
from .connection import Targets, connect, database_errors, describe_target
from .origin import refuse_mismatch
from .rebuild import rebuild
from .sink import SinkName


@dataclass(frozen=True, slots=True)
class RetryReport:
    """A sink's parked events: how many there were, those that still fail, and what was done."""

    sink: SinkName
    parked: int
    still: tuple[DeadLetter, ...]
    rebuilt: bool


def retry(log: Path, targets: Targets, settings: Settings) -> list[RetryReport]:
    """Try the dead letters of both sinks. Raises ProjectionMismatch for another log or settings."""
    sinks: tuple[tuple[SinkName, str], ...] = (
        ("graph", targets.graph_url),
        ("vectors", targets.vector_url),
    )
    return [_retry(log, targets, settings, sink, url) for sink, url in sinks]


def _retry(
    log: Path, targets: Targets, settings: Settings, sink: SinkName, url: str
) -> RetryReport:
    opened = connect(url, application="mapfold retry")
    with LogReader(log) as reader, opened as connection, database_errors(url):
        letters = checkpoints.parked(connection, sink)
        checkpoint = checkpoints.load(connection, sink)
        if checkpoint is None or not letters:
            return RetryReport(sink, 0, (), rebuilt=False)
        refuse_mismatch(checkpoint, sink, describe_target(url), log, reader, settings)
        still = tuple(_still_failing(reader, letters))
    if not still:
        rebuild(log, targets, settings, until=checkpoint.next_offset, only=sink)
    return RetryReport(sink, len(letters), still, rebuilt=not still)


def _still_failing(reader: LogReader, letters: list[DeadLetter]) -> list[DeadLetter]:
    failing = []
    for letter in letters:
        (event,) = reader.read(letter.offset, Offset(letter.offset + 1))
        judged = read_envelope(event, max_bytes=sys.maxsize)
        if isinstance(judged, Rejected):
            failing.append(DeadLetter(letter.offset, letter.key, letter.run_id, judged.reason))
    return failing
