"""The gap ledger of a log: folded from its events when a recorder opens it, or when one asks.

Of an envelope only two fields are needed, and reading those two is several times quicker than the
whole door. Envelopes of older versions do not count their keyframes and are passed over. A recorder
saves its ledger beside the log, so only the first reading ever is of the whole log.
"""

import contextlib
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from pydantic import BaseModel, ConfigDict, ValidationError

from ._ledger_cache import NAME, Note, load, save
from .envelope import ENVELOPE_VERSION, Int64
from .log.event import Event
from .log.fsync import delete_durably
from .log.reader import LogReader
from .losses import DEFAULT_SETTLE_NS, GapLedger, gap_of
from .system_events import LOSS_KEY, Loss, is_system_key

SAVE_EVERY: Final = 50_000
"""Events; they take a second or two to read."""
_MANY: Final = 100_000
"""Events that take seconds to read; below it nobody notices."""


class _Identity(BaseModel):
    """The two fields of an envelope that say which keyframe it is."""

    model_config = ConfigDict(strict=True, frozen=True, extra="ignore")

    run_id: str
    keyframe_id: Int64


def ledger_of(
    reader: LogReader,
    *,
    settle_ns: int = DEFAULT_SETTLE_NS,
    now_ns: int | None = None,
    note: Note | None = None,
) -> GapLedger:
    """The ledger of a whole log, beginning where a saved one ends.

    Holes the log never reported count as open since ``now_ns`` (by default: now, monotonic clock).
    ``note`` is told why a saved ledger is not used.
    """
    now_ns = time.monotonic_ns() if now_ns is None else now_ns
    start, ledger = _resume(reader, settle_ns, now_ns, note)
    return fold_ledger(reader.read(start), ledger, now_ns)


def keep_ledger(reader: LogReader, *, note: Note | None = None) -> GapLedger:
    """`ledger_of` for the log's writer, which saves it: on the way through a long log as well, so
    that one that is killed meanwhile reads no event twice but the last `SAVE_EVERY`."""
    now_ns = time.monotonic_ns()
    at, ledger = _resume(reader, DEFAULT_SETTLE_NS, now_ns, note)
    end = reader.next_offset
    if note is not None and end - at >= _MANY:
        note(f"reading {reader.path} once, to know which keyframes it lacks …")
    while at < end:
        upto = min(at + SAVE_EVERY, end)
        # Only a reading without an end looks for damage behind the last event.
        events = reader.read(at) if upto == end else reader.read(at, upto)
        fold_ledger(events, ledger, now_ns)
        save_ledger(reader.path, reader.log_id, upto, ledger)
        at = upto
    return ledger


def _resume(
    reader: LogReader, settle_ns: int, now_ns: int, note: Note | None
) -> tuple[int, GapLedger]:
    """The saved ledger and the offset behind what it knows; an empty one and 0 if there is none."""
    ledger = GapLedger(settle_ns)
    saved = load(reader, note)
    if saved is None:
        return 0, ledger
    ledger.restore(saved.states(), now_ns)
    return saved.next_offset, ledger


def unread_events(reader: LogReader) -> int:
    """How many events `ledger_of` would have to read."""
    saved = load(reader)
    return reader.next_offset - (0 if saved is None else saved.next_offset)


def save_ledger(path: Path, log_id: str, next_offset: int, ledger: GapLedger) -> None:
    """Save the ledger of the first ``next_offset`` events of the log at ``path``, as a cache.

    They must be durable, with everything the ledger reported among them.
    """
    save(path, log_id, next_offset, ledger)


def forget_ledger(path: Path) -> None:
    """Delete the saved ledger of the log at ``path``: the log has lost events that it knows."""
    with contextlib.suppress(OSError):  # it is not believed either while a segment is missing
        delete_durably(path / NAME)


def fold_ledger(events: Iterable[Event], ledger: GapLedger, now_ns: int) -> GapLedger:
    """Take ``events`` into ``ledger``, which is also returned."""
    for event in events:
        if event.key == LOSS_KEY:
            _take_loss(ledger, event.payload, now_ns)
        elif not is_system_key(event.key):
            identity = _identity(event)
            if identity is not None:
                ledger.record(*identity, now_ns)
    return ledger


def _take_loss(ledger: GapLedger, payload: bytes, now_ns: int) -> None:
    try:
        loss = Loss.model_validate_json(payload)
    except ValidationError:
        return  # of a later version; what it says was lost is still seen in the keyframes
    gap = gap_of(loss)
    if gap is not None:
        ledger.assume(gap, now_ns)


def _identity(event: Event) -> tuple[str, int] | None:
    if event.version != ENVELOPE_VERSION:
        return None
    try:
        found = _Identity.model_validate_json(event.payload)
    except ValidationError:
        return None  # an envelope the fold cannot read either; `log verify` names it
    return found.run_id, found.keyframe_id
