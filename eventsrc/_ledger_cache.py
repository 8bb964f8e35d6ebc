"""A saved gap ledger beside its log: ``.ledger.json``, a cache, safe to delete.

It is believed only if it is of this log, of no more events than the log has, and if the segments
it was folded from are still there: a ledger that knows events which the log has lost would have a
recorder acknowledge them, and the robot throw away the last copy. Recovery, which takes events
away, deletes it first.
"""

import contextlib
from pathlib import Path
from typing import Final, Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from .log._lineage import lineage, still_holds
from .log.fsync import sync_directory, unlink_quietly
from .log.reader import LogReader
from .losses import GapLedger, RunState

NAME: Final = ".ledger.json"


class SavedLedger(BaseModel):
    """The ledger of the first ``next_offset`` events of the log ``log_id``."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    format: Literal[2] = 2
    log_id: str
    next_offset: int
    segments: tuple[str, ...]
    runs: tuple[RunState, ...]


def load(reader: LogReader) -> SavedLedger | None:
    """The saved ledger of a log; None if there is none that can be believed."""
    try:
        saved = SavedLedger.model_validate_json((reader.path / NAME).read_bytes())
        believable = (
            saved.log_id == reader.log_id
            and saved.next_offset <= reader.next_offset
            and still_holds(saved.segments, lineage(reader.path, saved.next_offset))
        )
    except (OSError, ValidationError):
        return None
    return saved if believable else None


def save(path: Path, log_id: str, next_offset: int, ledger: GapLedger) -> None:
    """Replace the saved ledger. That it cannot be written is no error: it is a cache."""
    temporary = path / f"{NAME}.new"
    with contextlib.suppress(OSError):
        saved = SavedLedger(
            log_id=log_id,
            next_offset=next_offset,
            segments=lineage(path, next_offset),
            runs=ledger.state(),
        )
        temporary.write_text(saved.model_dump_json())
        temporary.replace(path / NAME)


def forget(path: Path) -> None:
    """Delete the saved ledger, so that not even a power cut brings it back. Raises OSError."""
    unlink_quietly(path / NAME)
    sync_directory(path)
