"""What a log's events give to a fold: envelopes and occupancy maps, validated, with unit vectors;
and of mapfold's own events the commands and the vectors of another space.

Parsing an event does not depend on earlier ones, so several processes can share the work.

Commands are read by key: of sealed segments only the chunks that hold one, by their index. An event
on ``mapfold/command`` that is no command is an error that names its offset: leaving it out would
give another map than its author asked for.
"""

import hashlib
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eventsrc.base.errors import LogDamaged
from eventsrc.base.machine import gc_paused
from eventsrc.base.text import advised
from eventsrc.envelope.commands import InvalidCommand, Reembed, UnknownKind, parse_command
from eventsrc.envelope.forms import read_envelope, read_envelopes
from eventsrc.envelope.ingest import Accepted, Rejected
from eventsrc.envelope.model import FIRST_OFFSET, DetId, Offset
from eventsrc.envelope.occupancy_map import InvalidMap, OccupancyMap, decode_map
from eventsrc.envelope.system_events import (
    COMMAND_KEY,
    EMBEDDINGS_KEY,
    MAP_KEY,
    InvalidEmbeddings,
    decode_embeddings,
)
from eventsrc.log import Event, LogReader
from projections.fold.corrections import Corrections, RecordedCommand, compile_corrections
from projections.fold.edited_events import Reembedded
from projections.fold.exact import Units, unit_vectors
from projections.fold.map_errors import FoldError, SettingsError
from projections.fold.settings import Settings

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


def read_command(event: Event) -> RecordedCommand:
    """The command of an event on ``mapfold/command``. Raises FoldError."""
    try:
        command = parse_command(event.payload)
        if command.kind == "use-settings":
            Settings.from_document(command.settings)
    except UnknownKind as error:
        raise FoldError(
            event.offset,
            f"{error}; update mapfold, or look at the map before it: {_before(event.offset)}",
        ) from None
    except (InvalidCommand, SettingsError) as error:
        raise FoldError(
            event.offset,
            f"it is on {COMMAND_KEY}, but no command that this version knows: {error}; update "
            f"mapfold, or look at the map before it: {_before(event.offset)}",
        ) from None
    return RecordedCommand(event.offset, command)


def _before(offset: Offset) -> str:
    return f"`{advised('state', '--at', offset)}`"


@gc_paused()
def read_commands(
    reader: LogReader, until: Offset | None = None, start: Offset = FIRST_OFFSET
) -> list[RecordedCommand]:
    """The commands from ``start`` to before ``until``, all for None, in order. Raises FoldError,
    LogDamaged."""
    events = reader.read(start, until, keys=(COMMAND_KEY,))
    return [read_command(event) for event in events]


@gc_paused()
def read_corrections(reader: LogReader, known_at: Offset | None = None) -> Corrections:
    """The corrections of the commands before ``known_at``, of all for None. Raises FoldError,
    LogDamaged."""
    return compile_corrections(read_commands(reader, known_at))


def vectors_of(
    reader: LogReader, settings: Settings, corrections: Corrections
) -> Reembedded | None:
    """The vectors of the settings' space that the log has beside those in envelopes; None if none
    are in force. Raises FoldError, LogDamaged."""
    commands = corrections.reembedded_for(settings)
    return _read(reader.path, reader.log_id, commands) if commands else None


@lru_cache(maxsize=2)
def _read(log: Path, _log_id: str, commands: tuple[Reembed, ...]) -> Reembedded:
    vectors: dict[DetId, NDArray[np.float32]] = {}
    with LogReader(log) as reader:
        for command in commands:
            digest = hashlib.sha256()
            for event in reader.read(command.first, command.end, keys={EMBEDDINGS_KEY}):
                try:
                    found = decode_embeddings(event.payload)
                except InvalidEmbeddings as error:
                    raise FoldError(event.offset, f"it is on {EMBEDDINGS_KEY}: {error}") from None
                if found.space == command.space:
                    digest.update(event.payload)
                    for det_id, row in zip(found.det_ids, found.vectors, strict=True):
                        vectors.setdefault(det_id, row)
            if digest.hexdigest() != command.sha256:
                raise FoldError(
                    command.first,
                    f"the vectors of {command.space!r} from here to offset {command.end} are not"
                    f" those that command {command.command_id} was given for; run"
                    f" `{advised('log', 'verify')}`, and undo the command to map without them",
                )
    return Reembedded(commands[0].space, vectors)


@dataclass(frozen=True, slots=True)
class LogSpace:
    """A space: its model, None where detections name none, and its dimension. ``recorded``
    detections have a vector of it in their envelope, ``reembedded`` others by commands in force."""

    model: str | None
    dim: int
    recorded: int
    reembedded: int


@dataclass(frozen=True, slots=True)
class LogSpaces:
    """``spaces`` by their first vector, those without a recorded one last; ``bare`` of the
    ``detections`` were recorded without a vector. Each det_id counts once."""

    detections: int
    bare: int
    spaces: tuple[LogSpace, ...]


def log_spaces(
    reader: LogReader, progress: Callable[[int, int], None] = lambda *_: None
) -> LogSpaces:
    """Count the spaces of a log, from all its envelopes. Raises FoldError, LogDamaged."""
    corrections = read_corrections(reader)
    recorded: Counter[tuple[str | None, int]] = Counter()
    spaces: dict[DetId, tuple[str | None, int] | None] = {}
    for event in reader.read():
        progress(event.offset + 1, reader.next_offset)
        if not event.is_envelope:
            continue
        accepted = read_envelope(event, max_bytes=sys.maxsize)
        if not isinstance(accepted, Accepted):
            continue
        detections = accepted.envelope.detections
        for det_id, detection, vector in zip(
            accepted.det_ids, detections, accepted.vectors, strict=True
        ):
            if det_id not in spaces:
                space = None if vector is None else (detection.embedding_model, len(vector))
                spaces[det_id] = space
                if space is not None:
                    recorded[space] += 1
    given: Counter[tuple[str | None, int]] = Counter()
    for model, dim in dict.fromkeys((each.space, each.dim) for each in corrections.reembedded):
        chosen = Settings(embedding_model=model, embedding_dim=dim)
        vectors = vectors_of(reader, chosen, corrections)
        given[model, dim] = sum(
            space != (model, dim) and vectors is not None and det_id in vectors
            for det_id, space in spaces.items()
        )
    found = tuple(
        LogSpace(model, dim, recorded[model, dim], given[model, dim])
        for model, dim in dict.fromkeys((*recorded, *given))
    )
    return LogSpaces(len(spaces), sum(space is None for space in spaces.values()), found)
