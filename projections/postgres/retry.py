"""Retry parked events: rebuild a sink once all of its parked events can be folded.

A parked event, once folded, changes everything after it, so it cannot be added later. If all parked
events of a sink can be read now (by a newer mapfold), the sink is rebuilt up to its checkpoint. If
one still cannot, nothing is changed.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

from eventsrc.envelope.forms import read_envelope
from eventsrc.envelope.ingest import Rejected
from eventsrc.envelope.model import Offset
from eventsrc.log import LogReader
from projections.fold.settings import Settings

from . import checkpoints
from .checkpoints import DeadLetter
from .connection import Targets, connect, database_errors, describe_target
from .inputs import LogInputs, SettingsOf
from .origin import refuse_mismatch
from .rebuild import rebuild
from .sink import SinkName


@dataclass(frozen=True, slots=True)
class RetryReport:
    """A sink's parked events: how many, which still fail, whether it was rebuilt."""

    sink: SinkName
    parked: int
    still: tuple[DeadLetter, ...]
    rebuilt: bool


def retry(log: Path, targets: Targets, settings: Settings | SettingsOf) -> list[RetryReport]:
    """Retry the parked events of both sinks. Raises ProjectionMismatch."""
    sinks: tuple[tuple[SinkName, str], ...] = (
        ("graph", targets.graph_url),
        ("vectors", targets.vector_url),
    )
    return [_retry(log, targets, settings, sink, url) for sink, url in sinks]


def _retry(
    log: Path, targets: Targets, settings: Settings | SettingsOf, sink: SinkName, url: str
) -> RetryReport:
    opened = connect(url, application="mapfold retry")
    with LogReader(log) as reader, opened as connection, database_errors(url):
        letters = checkpoints.parked(connection, sink)
        checkpoint = checkpoints.load(connection, sink)
        if checkpoint is None or not letters:
            return RetryReport(sink, 0, (), rebuilt=False)
        inputs = LogInputs.read(reader, settings).at(checkpoint.known_to)
        refuse_mismatch(checkpoint, sink, describe_target(url), log, reader, inputs)
        still = tuple(_still_rejected(reader, letters))
    if not still:
        rebuild(
            log,
            targets,
            settings,
            until=checkpoint.next_offset,
            known_at=checkpoint.known_to,
            only=sink,
        )
    return RetryReport(sink, len(letters), still, rebuilt=not still)


def _still_rejected(reader: LogReader, letters: list[DeadLetter]) -> list[DeadLetter]:
    failing = []
    for letter in letters:
        (event,) = reader.read(letter.offset, Offset(letter.offset + 1))
        parsed = read_envelope(event, max_bytes=sys.maxsize)
        if isinstance(parsed, Rejected):
            failing.append(DeadLetter(letter.offset, letter.key, letter.run_id, parsed.reason))
    return failing
