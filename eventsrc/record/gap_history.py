"""The gap ledger of a log: keyframes its runs lack, folded from its events and saved beside it.

Of an envelope only run and keyframe id are needed, and reading these two is several times quicker
than a full validation. Bare lists of detections name no keyframe and are skipped.

The saved ledger, ``.ledger.json``, is a cache that is safe to delete; with it only the first
reading is of the whole log. It is used only if its checksum holds, its content is consistent, it is
of this log and of no more events than the log has, and the segments it was folded from are still
there: with a ledger of events that the log has lost, a recorder would acknowledge them, and the
robot would delete the last copy. Recovery, which removes events, deletes it first. If it is not
used, the log is read again and the reason is reported.

The file is one JSON object, ``{"sha256": …, "ledger": {…}}``; the hash is that of the bytes of the
inner object.
"""

import contextlib
import hashlib
import os
import re
import stat
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import BaseModel, ConfigDict, FailFast, Field, ValidationError

from eventsrc.envelope.gaps import DEFAULT_SETTLE_NS, GapLedger, RunState, gap_of, is_consistent
from eventsrc.envelope.model import FIRST_OFFSET, Int64, KeyframeId, Offset, RunId, has_keyframe_id
from eventsrc.envelope.system_events import LOSS_KEY, Loss
from eventsrc.log.durable_files import delete_durably, unlink_quietly, write_all
from eventsrc.log.event import Event
from eventsrc.log.format import LEDGER
from eventsrc.log.log_identity import same_but_sealed, segment_signatures
from eventsrc.log.reader import LogReader

MAX_BYTES: Final = 8 * 1024 * 1024
"""Bound of the saved ledger, about half a million gaps. A larger one is not saved: loading it would
take more memory than reading the log."""
_FILE_PATTERN: Final = re.compile(rb'\{"sha256":"([0-9a-f]{64})","ledger":(\{.*\})\}', re.DOTALL)

Note = Callable[[str], None]
"""Receives one line of text for people."""


Run = tuple[RunId, Int64, Int64, Annotated[tuple[tuple[Int64, Int64, bool], ...], FailFast()]]
"""A `RunState` in the file."""


class SavedLedger(BaseModel):
    """The ledger of the first ``next_offset`` events of the log ``log_id``."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    format: Literal[3] = 3
    log_id: str
    next_offset: Annotated[Offset, Field(ge=0, lt=2**63)]
    segments: Annotated[tuple[str, ...], FailFast()]
    runs: Annotated[tuple[Run, ...], FailFast()]

    def states(self) -> list[RunState[RunId]]:
        """The argument of `GapLedger.restore`."""
        return [RunState(*run) for run in self.runs]


class _Unusable(Exception):
    """The reason why a saved ledger is not used."""


def _load(reader: LogReader, note: Note | None = None) -> SavedLedger | None:
    """The saved ledger of a log; None if there is none or it is not used, with a ``note``."""
    path = reader.path / LEDGER
    try:
        saved = _decode(_read(path))
        _check_belongs(saved, reader)
    except FileNotFoundError:
        return None
    except (OSError, _Unusable) as error:
        if note is not None:
            reason = error.strerror if isinstance(error, OSError) else error
            note(f"{path} is not used: {reason}; the gaps are counted again from the log")
        return None
    return saved


def _read(path: Path) -> bytes:
    """The file's bytes. Raises OSError, also for a symbolic link; _Unusable if it is not a regular
    file or larger than `MAX_BYTES`."""
    fd = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        status = os.fstat(fd)
        if not stat.S_ISREG(status.st_mode):
            raise _Unusable("it is not a regular file")
        if status.st_size > MAX_BYTES:
            raise _Unusable(f"it is {status.st_size:,} bytes large, more than {MAX_BYTES:,}")
        return os.read(fd, MAX_BYTES)
    finally:
        os.close(fd)


def _decode(data: bytes) -> SavedLedger:
    found = _FILE_PATTERN.fullmatch(data)
    if found is None:
        raise _Unusable("it is not a ledger as this version of mapfold saves it")
    if hashlib.sha256(found[2]).hexdigest().encode() != found[1]:
        raise _Unusable("its checksum does not match its content")
    try:
        return SavedLedger.model_validate_json(found[2])
    except ValidationError as error:
        fault = error.errors(include_url=False, include_context=False, include_input=False)[0]
        place = ".".join(map(str, fault["loc"]))
        raise _Unusable(f"its content is not valid: {place}: {fault['msg']}") from None


def _check_belongs(saved: SavedLedger, reader: LogReader) -> None:
    if not is_consistent(saved.states(), saved.next_offset):
        raise _Unusable("it holds keyframes or gaps that contradict each other")
    if saved.log_id != reader.log_id:
        raise _Unusable("it is of another log")
    if saved.next_offset > reader.next_offset:
        raise _Unusable(
            f"it covers {saved.next_offset} events, but the log has {reader.next_offset}"
        )
    if not same_but_sealed(saved.segments, segment_signatures(reader.path, saved.next_offset)):
        raise _Unusable("segments that it was made from have changed or are gone")


def encode(ledger: bytes) -> bytes:
    """The content of the file around the JSON of a `SavedLedger`."""
    digest = hashlib.sha256(ledger).hexdigest().encode()
    return b'{"sha256":"%s","ledger":%s}' % (digest, ledger)


def _write(path: Path, data: bytes) -> None:
    if len(data) > MAX_BYTES:
        unlink_quietly(path / LEDGER)
        return
    temporary = path / f"{LEDGER}.new"
    unlink_quietly(temporary)
    fd = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o644)
    try:
        write_all(fd, data)
    finally:
        os.close(fd)
    temporary.replace(path / LEDGER)


SAVE_EVERY: Final = 50_000
"""Events between two saves while a log is read; a second or two of reading."""
_NOTED_EVENTS: Final = 100_000
"""From this many events to read, which takes seconds, a note announces the reading."""


class _Identity(BaseModel):
    """The two fields of an envelope that say which keyframe it is."""

    model_config = ConfigDict(strict=True, frozen=True, extra="ignore")

    run_id: RunId
    keyframe_id: Annotated[KeyframeId, Field(ge=-(2**63), lt=2**63)]


def ledger_of(
    reader: LogReader,
    *,
    settle_ns: int = DEFAULT_SETTLE_NS,
    now_ns: int | None = None,
    note: Note | None = None,
) -> GapLedger[RunId]:
    """The ledger of a whole log; only events behind a usable saved ledger are read.

    Unreported holes count as open since ``now_ns`` (by default now, on the monotonic clock).
    ``note`` gets a line if a saved ledger is not used.
    """
    now_ns = time.monotonic_ns() if now_ns is None else now_ns
    start, ledger = _load_or_new(reader, settle_ns, now_ns, note)
    return fold_ledger(reader.read(start), ledger, now_ns)


def fold_and_save_ledger(reader: LogReader, *, note: Note | None = None) -> GapLedger[RunId]:
    """`ledger_of` for the log's writer, which saves the ledger at the end and after every
    `SAVE_EVERY` events: after a kill at most that many events are read again."""
    now_ns = time.monotonic_ns()
    at, ledger = _load_or_new(reader, DEFAULT_SETTLE_NS, now_ns, note)
    end = reader.next_offset
    if note is not None and end - at >= _NOTED_EVENTS:
        note(f"reading {reader.path} once, to find its missing keyframes …")
    while at < end:
        upto = min(Offset(at + SAVE_EVERY), end)
        # Only a reading without an end looks for damage behind the last event.
        events = reader.read(at) if upto == end else reader.read(at, upto)
        fold_ledger(events, ledger, now_ns)
        save_ledger(reader.path, reader.log_id, upto, ledger)
        at = upto
    return ledger


def _load_or_new(
    reader: LogReader, settle_ns: int, now_ns: int, note: Note | None
) -> tuple[Offset, GapLedger[RunId]]:
    """The saved ledger and its next offset; an empty ledger and 0 if there is none."""
    ledger: GapLedger[RunId] = GapLedger(settle_ns)
    saved = _load(reader, note)
    if saved is None:
        return FIRST_OFFSET, ledger
    ledger.restore(saved.states(), now_ns)
    return saved.next_offset, ledger


def unread_events(reader: LogReader) -> int:
    """How many events `ledger_of` would have to read."""
    saved = _load(reader)
    return reader.next_offset - (0 if saved is None else saved.next_offset)


def save_ledger(path: Path, log_id: str, next_offset: Offset, ledger: GapLedger[RunId]) -> None:
    """Save the ledger of the first ``next_offset`` events of the log at ``path``.

    These events must be durable, and the loss events of all reported gaps among them. Nothing is
    raised if the file cannot be written, since it is a cache, or if the log has keyframe ids that
    no envelope can have.
    """
    with contextlib.suppress(OSError, ValidationError):
        saved = SavedLedger(
            log_id=log_id,
            next_offset=next_offset,
            segments=segment_signatures(path, next_offset),
            runs=ledger.state(),
        )
        _write(path, encode(saved.model_dump_json().encode()))


def delete_ledger(path: Path) -> None:
    """Delete the saved ledger of the log at ``path``, which has lost events that it counts."""
    with contextlib.suppress(OSError):  # it is not used either while a segment is missing
        delete_durably(path / LEDGER)


def fold_ledger(events: Iterable[Event], ledger: GapLedger[RunId], now_ns: int) -> GapLedger[RunId]:
    """Add ``events`` to ``ledger``, which is also returned."""
    for event in events:
        if event.key == LOSS_KEY:
            # that of a later version is None; its gap still shows in the keyframe ids
            loss = loss_of(event)
            gap = None if loss is None else gap_of(loss)
            if gap is not None:
                ledger.add_reported(gap, now_ns)
        elif event.is_envelope and has_keyframe_id(event.version):
            identity = keyframe_of(event.payload)
            if identity is not None:
                ledger.record(*identity, now_ns)
    return ledger


def loss_of(event: Event) -> Loss | None:
    """The content of a loss event; None if it cannot be read, which `log verify` says."""
    try:
        return Loss.model_validate_json(event.payload)
    except ValidationError:
        return None


def keyframe_of(payload: bytes) -> tuple[RunId, KeyframeId] | None:
    """Run and keyframe of an envelope's JSON; None if it has none that a fold could read."""
    try:
        found = _Identity.model_validate_json(payload)
    except ValidationError:
        return None
    return found.run_id, found.keyframe_id
