"""Add vectors of another embedding space to a log, encoded from the crops that it keeps.

New vectors are appended in groups, each an event of its own on ``mapfold/embeddings`` that is
synced before the next is made. At the end one command, ``reembed``, puts all of them into force:
until then no map has any. A run that was killed is continued by the next one, and a run that finds
nothing to do appends nothing.
"""

import hashlib
import sys
import uuid
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Literal, NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from eventsrc.base.errors import LogDamaged, MisuseError
from eventsrc.envelope.commands import InvalidCommand, Reembed, encode_command, parse_command
from eventsrc.envelope.crops import CROP_SCHEMA, CROPS_TOPIC, Crop, InvalidCrop, decode_crop
from eventsrc.envelope.forms import read_envelope
from eventsrc.envelope.ingest import Accepted
from eventsrc.envelope.model import FIRST_OFFSET, DetId, Offset
from eventsrc.envelope.system_events import (
    COMMAND_KEY,
    EMBEDDINGS_KEY,
    MAX_REEMBEDDED,
    InvalidEmbeddings,
    NewVectors,
    decode_embeddings,
    is_usable,
)
from eventsrc.log import Event, LogReader, LogWriter, VerbatimEvent

DEFAULT_BATCH: Final = 64
_MOST_VALUES: Final = 1_000_000
"""Bound of the numbers in the vectors of one event."""
_MOST_NAMED: Final = 20

Vector: TypeAlias = NDArray[np.float32]


class CropEncoder(Protocol):
    """An encoder of crops: the name of its ``space``, the ``dimension`` of its vectors, the SHA-256
    of its model."""

    @property
    def space(self) -> str: ...
    @property
    def dimension(self) -> int: ...
    @property
    def sha256(self) -> str: ...

    def encode(self, jpegs: Sequence[bytes]) -> list[Vector | str]:
        """A vector for each JPEG, or why it cannot be decoded."""


class Fault(NamedTuple):
    """A crop that got no vector: the offset of its event, its det_id if readable, the reason."""

    offset: Offset
    det_id: DetId | None
    reason: str


@dataclass
class Reembedding:
    """Counts of a run, most of them of detections.

    Of all ``detections`` of the log, ``own`` were recorded with a vector of the space, ``known``
    got one by an earlier run and ``added`` by this one. ``without_crop`` have no crop in the log.
    ``corrupt`` crops cannot be decoded; for ``unusable`` ones the encoder answered NaN or zero.
    ``command`` is the offset of the command if one was appended.
    """

    space: str
    dimension: int
    detections: int = 0
    own: int = 0
    known: int = 0
    added: int = 0
    without_crop: int = 0
    corrupt: int = 0
    unusable: int = 0
    command: int | None = None
    stopped: bool = False
    faults: list[Fault] = field(default_factory=list)
    """The first few corrupt or unusable crops."""

    def note(self, kind: Literal["corrupt", "unusable"], fault: Fault) -> None:
        """Count a crop without a vector."""
        setattr(self, kind, getattr(self, kind) + 1)
        if len(self.faults) < _MOST_NAMED:
            self.faults.append(fault)


def reembed(
    log: Path,
    encoder: CropEncoder,
    *,
    topics: Collection[str] = (CROPS_TOPIC,),
    batch: int = DEFAULT_BATCH,
    issued_by: str,
    reason: str = "",
    progress: Callable[[int, int], None] = lambda *_: None,
    stopped: Callable[[], bool] = lambda: False,
) -> Reembedding:
    """Add vectors of ``encoder`` for the detections that have a crop and no vector of its space.

    ``progress`` gets the number of events read and of all events. When ``stopped`` returns True,
    the run ends after the current group and appends no command. Raises LogBusy while another
    process writes the log, LogNotFound, MisuseError if the log has vectors of the space with
    another dimension or by another encoder.
    """
    with LogReader(log):
        pass  # raises LogNotFound; a writer would create the log
    with LogWriter(log) as writer:
        with LogReader(log) as reader:
            state = _State.read(reader, encoder)
            done = Reembedding(encoder.space, encoder.dimension)
            done.detections, done.own = len(state.wanted) + len(state.own), len(state.own)
            done.known = len(state.given & state.wanted)
            state.wanted -= state.given
            group = max(1, min(batch, MAX_REEMBEDDED, _MOST_VALUES // encoder.dimension))
            for crops in _groups(reader, topics, state.wanted, group, done, progress):
                state.tried.update(crop.det_id for _, crop in crops)
                state.wanted -= _append(writer, encoder, crops, done)
                if stopped():
                    done.stopped = True
                    return done
            done.without_crop = len(state.wanted - state.tried)
            progress(reader.next_offset, reader.next_offset)
        with LogReader(log) as reader:
            command = _command(reader, encoder, state.covered, issued_by, reason)
        if command is not None:
            done.command = writer.append(COMMAND_KEY, encode_command(command))
            writer.sync()
    return done


@dataclass
class _State:
    """The detections of a log by where their vector of the space is: ``own`` have it in their
    envelope, ``wanted`` are the others, ``given`` have it in an event on ``mapfold/embeddings``,
    ``tried`` had a crop read by this run. Events before offset ``covered`` have a command."""

    own: set[DetId] = field(default_factory=set)
    wanted: set[DetId] = field(default_factory=set)
    given: set[DetId] = field(default_factory=set)
    tried: set[DetId] = field(default_factory=set)
    covered: Offset = FIRST_OFFSET

    @classmethod
    def read(cls, reader: LogReader, encoder: CropEncoder) -> "_State":
        """Read all events. Raises MisuseError for vectors of the space that have another dimension
        or are by another encoder."""
        state = cls()
        for event in reader.read():
            if event.key == EMBEDDINGS_KEY:
                state._add_given(event, encoder)
            elif event.key == COMMAND_KEY:
                state._add_command(event, encoder)
            elif event.is_envelope:
                state._add_envelope(event, encoder)
        return state

    def _add_envelope(self, event: Event, encoder: CropEncoder) -> None:
        accepted = read_envelope(event, max_bytes=sys.maxsize)
        if not isinstance(accepted, Accepted):
            return
        detections = accepted.envelope.detections
        for det_id, detection, vector in zip(
            accepted.det_ids, detections, accepted.vectors, strict=True
        ):
            if det_id in self.own or det_id in self.wanted:
                continue
            if vector is None or detection.embedding_model != encoder.space:
                self.wanted.add(det_id)
                continue
            _check_dimension(event, len(vector), encoder)
            self.own.add(det_id)

    def _add_given(self, event: Event, encoder: CropEncoder) -> None:
        found = _decoded(event)
        if found.space != encoder.space:
            return
        _check_dimension(event, found.vectors.shape[1], encoder)
        if found.encoder != encoder.sha256:
            raise MisuseError(
                f"the vectors of space {found.space!r} at offset {event.offset} are by another"
                f" model (SHA-256 {found.encoder[:16]}…, this one's is {encoder.sha256[:16]}…);"
                " give the space of this one another name"
            )
        self.given.update(found.det_ids)

    def _add_command(self, event: Event, encoder: CropEncoder) -> None:
        try:
            command = parse_command(event.payload)
        except InvalidCommand:  # `log verify` names it; no fold goes past it
            return
        if isinstance(command, Reembed) and command.space == encoder.space:
            self.covered = max(self.covered, command.end)


def _decoded(event: Event) -> NewVectors:
    try:
        return decode_embeddings(event.payload)
    except InvalidEmbeddings as error:
        raise LogDamaged(f"offset {event.offset}, on {EMBEDDINGS_KEY}: {error}") from None


def _check_dimension(event: Event, dim: int, encoder: CropEncoder) -> None:
    if dim != encoder.dimension:
        raise MisuseError(
            f"the vectors of space {encoder.space!r} in this log have {dim:,} values (offset"
            f" {event.offset}), those of this encoder {encoder.dimension:,}; give its space another"
            " name"
        )


def _groups(
    reader: LogReader,
    topics: Collection[str],
    wanted: set[DetId],
    size: int,
    done: Reembedding,
    progress: Callable[[int, int], None],
) -> Iterator[list[tuple[Offset, Crop]]]:
    """The crops of wanted detections, ``size`` at a time; each detection once in a group."""
    group: dict[DetId, tuple[Offset, Crop]] = {}
    for event in reader.read(keys=set(topics)):
        progress(event.offset, reader.next_offset)
        if not isinstance(event, VerbatimEvent) or event.format.schema != CROP_SCHEMA:
            continue
        try:
            crop = decode_crop(event.payload)
        except InvalidCrop as error:
            done.note("corrupt", Fault(event.offset, None, str(error)))
            continue
        if crop.det_id in wanted and crop.det_id not in group:
            group[crop.det_id] = event.offset, crop
            if len(group) == size:
                yield list(group.values())
                group.clear()
    if group:
        yield list(group.values())


def _append(
    writer: LogWriter,
    encoder: CropEncoder,
    crops: list[tuple[Offset, Crop]],
    done: Reembedding,
) -> set[DetId]:
    """Encode a group of crops, append the vectors and sync; return the detections that got one."""
    det_ids, rows = [], []
    answers = encoder.encode([crop.jpeg for _, crop in crops])
    for (offset, crop), answer in zip(crops, answers, strict=True):
        if isinstance(answer, str):
            done.note("corrupt", Fault(offset, crop.det_id, answer))
        elif len(answer) != encoder.dimension:
            raise MisuseError(
                f"the encoder answered {len(answer):,} values for {crop.det_id}, not"
                f" {encoder.dimension:,}"
            )
        elif not is_usable(answer.reshape(1, -1))[0]:
            done.note("unusable", Fault(offset, crop.det_id, "the encoder answers NaN or zero"))
        else:
            det_ids.append(crop.det_id)
            rows.append(answer)
    if rows:
        made = NewVectors(encoder.space, encoder.sha256, tuple(det_ids), np.array(rows, np.float32))
        writer.append(EMBEDDINGS_KEY, made.encode())
        writer.sync()
        done.added += len(det_ids)
    return set(det_ids)


def _command(
    reader: LogReader, encoder: CropEncoder, covered: Offset, issued_by: str, reason: str
) -> Reembed | None:
    """The command for the vectors from offset ``covered`` on; None if there are none."""
    digest, first, end, count = hashlib.sha256(), None, FIRST_OFFSET, 0
    for event in reader.read(covered, keys={EMBEDDINGS_KEY}):
        found = _decoded(event)
        if found.space == encoder.space:
            digest.update(event.payload)
            first = event.offset if first is None else first
            end, count = Offset(event.offset + 1), count + len(found.det_ids)
    if first is None:
        return None
    return Reembed(
        command_id=uuid.uuid4().hex,
        issued_by=issued_by,
        reason=reason,
        space=encoder.space,
        dim=encoder.dimension,
        first=first,
        end=end,
        detections=count,
        sha256=digest.hexdigest(),
    )
