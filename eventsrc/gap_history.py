"""The gap ledger of a log: folded from its events when a recorder opens it, or when one asks.

Of an envelope only two fields are needed, and reading those two is several times quicker than the
whole door. Envelopes of older versions do not count their keyframes and are passed over. A recorder
saves its ledger beside the log, so only the first reading ever is of the whole log.

A saved gap ledger beside its log: ``.ledger.json``, a cache, safe to delete.

It is believed only if it is what was saved, to the byte, if a ledger can be like that at all, if it
is of this log, of no more events than the log has, and if the segments it was folded from are still
there: a ledger that knows events which the log has lost would have a recorder acknowledge them, and
the robot throw away the last copy. Recovery, which takes events away, deletes it first. Where there
is any doubt the log is counted again, and the reason told.

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

from eventsrc.log.durable_files import delete_durably, unlink_quietly, write_all
from eventsrc.log.event import Event
from eventsrc.log.format import LEDGER
from eventsrc.log.log_identity import lineage, still_holds
from eventsrc.log.reader import LogReader

from .envelope import ENVELOPE_VERSION, FIRST_OFFSET, Int64, KeyframeId, Offset, RunId
from .gaps import DEFAULT_SETTLE_NS, GapLedger, RunState, gap_of, sound
from .system_events import LOSS_KEY, Loss, is_system_key

NAME: Final = LEDGER
MAX_BYTES: Final = 8 * 1024 * 1024
"""Half a million gaps. A larger ledger is not saved: reading it would cost more memory than the log
it is of."""
_FORM: Final = re.compile(rb'\{"sha256":"([0-9a-f]{64})","ledger":(\{.*\})\}', re.DOTALL)

Note = Callable[[str], None]
"""Takes one line for people."""


Run = tuple[RunId, Int64, Int64, Annotated[tuple[tuple[Int64, Int64, bool], ...], FailFast()]]
"""A `RunState` as it is saved."""


class SavedLedger(BaseModel):
    """The ledger of the first ``next_offset`` events of the log ``log_id``."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    format: Literal[3] = 3
    log_id: str
    next_offset: Annotated[Offset, Field(ge=0, lt=2**63)]
    segments: Annotated[tuple[str, ...], FailFast()]
    runs: Annotated[tuple[Run, ...], FailFast()]

    def states(self) -> list[RunState[RunId]]:
        """What `GapLedger.restore` takes."""
        return [RunState(*run) for run in self.runs]


class _Doubt(Exception):
    """Why a saved ledger is not believed."""


def load(reader: LogReader, note: Note | None = None) -> SavedLedger | None:
    """The saved ledger of a log; None if there is none, or none that can be believed, which
    ``note`` is told."""
    path = reader.path / NAME
    try:
        saved = _decode(_read(path))
        _check(saved, reader)
    except FileNotFoundError:
        return None
    except (OSError, _Doubt) as error:
        if note is not None:
            reason = error.strerror if isinstance(error, OSError) else error
            note(f"{path} is not used: {reason}; what it says is counted again from the log")
        return None
    return saved


def _read(path: Path) -> bytes:
    """Raises OSError, also for a symbolic link, and _Doubt for what is no file or a huge one."""
    fd = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        status = os.fstat(fd)
        if not stat.S_ISREG(status.st_mode):
            raise _Doubt("it is not a regular file")
        if status.st_size > MAX_BYTES:
            raise _Doubt(f"it is {status.st_size:,} bytes large, more than {MAX_BYTES:,}")
        return os.read(fd, MAX_BYTES)
    finally:
        os.close(fd)


def _decode(data: bytes) -> SavedLedger:
    found = _FORM.fullmatch(data)
    if found is None:
        raise _Doubt("it is not a ledger as this version of mapfold saves it")
    if hashlib.sha256(found[2]).hexdigest().encode() != found[1]:
        raise _Doubt("its checksum does not match its content")
    try:
        return SavedLedger.model_validate_json(found[2])
    except ValidationError as error:
        fault = error.errors(include_url=False, include_context=False, include_input=False)[0]
        place = ".".join(map(str, fault["loc"]))
        raise _Doubt(f"it holds what no ledger does: {place}: {fault['msg']}") from None


def _check(saved: SavedLedger, reader: LogReader) -> None:
    if not sound(saved.states(), saved.next_offset):
        raise _Doubt("it holds keyframes or gaps that contradict each other")
    if saved.log_id != reader.log_id:
        raise _Doubt("it is of another log")
    if saved.next_offset > reader.next_offset:
        raise _Doubt(f"it knows {saved.next_offset} events and the log has {reader.next_offset}")
    if not still_holds(saved.segments, lineage(reader.path, saved.next_offset)):
        raise _Doubt("segments that it was made from have changed or are gone")


def save(path: Path, log_id: str, next_offset: Offset, ledger: GapLedger[RunId]) -> None:
    """Replace the saved ledger. That it cannot be written is no error: it is a cache. Nor is it one
    if the log names keyframes that no envelope can have."""
    with contextlib.suppress(OSError, ValidationError):
        saved = SavedLedger(
            log_id=log_id,
            next_offset=next_offset,
            segments=lineage(path, next_offset),
            runs=ledger.state(),
        )
        _write(path, encode(saved.model_dump_json().encode()))


def encode(ledger: bytes) -> bytes:
    """The content of the file around the JSON of a `SavedLedger`."""
    digest = hashlib.sha256(ledger).hexdigest().encode()
    return b'{"sha256":"%s","ledger":%s}' % (digest, ledger)


def _write(path: Path, data: bytes) -> None:
    if len(data) > MAX_BYTES:
        unlink_quietly(path / NAME)
        return
    temporary = path / f"{NAME}.new"
    unlink_quietly(temporary)
    fd = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o644)
    try:
        write_all(fd, data)
    finally:
        os.close(fd)
    temporary.replace(path / NAME)


SAVE_EVERY: Final = 50_000
"""Events; they take a second or two to read."""
_MANY: Final = 100_000
"""Events that take seconds to read. With fewer no line is printed."""


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
    """The ledger of a whole log, beginning where a saved one ends.

    Holes the log never reported count as open since ``now_ns`` (by default: now, monotonic clock).
    ``note`` is told why a saved ledger is not used.
    """
    now_ns = time.monotonic_ns() if now_ns is None else now_ns
    start, ledger = _resume(reader, settle_ns, now_ns, note)
    return fold_ledger(reader.read(start), ledger, now_ns)


def keep_ledger(reader: LogReader, *, note: Note | None = None) -> GapLedger[RunId]:
    """`ledger_of` for the log's writer, which saves it: on the way through a long log as well, so
    that one that is killed meanwhile reads no event twice but the last `SAVE_EVERY`."""
    now_ns = time.monotonic_ns()
    at, ledger = _resume(reader, DEFAULT_SETTLE_NS, now_ns, note)
    end = reader.next_offset
    if note is not None and end - at >= _MANY:
        note(f"reading {reader.path} once, to know which keyframes it lacks …")
    while at < end:
        upto = min(Offset(at + SAVE_EVERY), end)
        # Only a reading without an end looks for damage behind the last event.
        events = reader.read(at) if upto == end else reader.read(at, upto)
        fold_ledger(events, ledger, now_ns)
        save_ledger(reader.path, reader.log_id, upto, ledger)
        at = upto
    return ledger


def _resume(
    reader: LogReader, settle_ns: int, now_ns: int, note: Note | None
) -> tuple[Offset, GapLedger[RunId]]:
    """The saved ledger and the offset behind what it knows; an empty one and 0 if there is none."""
    ledger: GapLedger[RunId] = GapLedger(settle_ns)
    saved = load(reader, note)
    if saved is None:
        return FIRST_OFFSET, ledger
    ledger.restore(saved.states(), now_ns)
    return saved.next_offset, ledger


def unread_events(reader: LogReader) -> int:
    """How many events `ledger_of` would have to read."""
    saved = load(reader)
    return reader.next_offset - (0 if saved is None else saved.next_offset)


def save_ledger(path: Path, log_id: str, next_offset: Offset, ledger: GapLedger[RunId]) -> None:
    """Save the ledger of the first ``next_offset`` events of the log at ``path``, as a cache.

    They must be durable, with everything the ledger reported among them.
    """
    save(path, log_id, next_offset, ledger)


def forget_ledger(path: Path) -> None:
    """Delete the saved ledger of the log at ``path``: the log has lost events that it knows."""
    with contextlib.suppress(OSError):  # it is not believed either while a segment is missing
        delete_durably(path / NAME)


def fold_ledger(events: Iterable[Event], ledger: GapLedger[RunId], now_ns: int) -> GapLedger[RunId]:
    """Take ``events`` into ``ledger``, which is also returned."""
    for event in events:
        if event.key == LOSS_KEY:
            _take_loss(ledger, event.payload, now_ns)
        elif not is_system_key(event.key):
            identity = _identity(event)
            if identity is not None:
                ledger.record(*identity, now_ns)
    return ledger


def _take_loss(ledger: GapLedger[RunId], payload: bytes, now_ns: int) -> None:
    try:
        loss = Loss.model_validate_json(payload)
    except ValidationError:
        return  # of a later version; what it says was lost is still seen in the keyframes
    gap = gap_of(loss)
    if gap is not None:
        ledger.assume(gap, now_ns)


def _identity(event: Event) -> tuple[RunId, KeyframeId] | None:
    if event.version != ENVELOPE_VERSION:
        return None
    try:
        found = _Identity.model_validate_json(event.payload)
    except ValidationError:
        return None  # an envelope the fold cannot read either; `log verify` names it
    return found.run_id, found.keyframe_id
