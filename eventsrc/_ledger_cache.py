"""A saved gap ledger beside its log: ``.ledger.json``, a cache, safe to delete.

It is believed only if it is of this log, of no more events than the log has, and if nobody has
recovered the log since: recovery may take events away that the ledger has seen.
"""

import contextlib
from pathlib import Path
from typing import Final, Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from .log.reader import LogReader
from .losses import GapLedger, RunState

NAME: Final = ".ledger.json"


class SavedLedger(BaseModel):
    """The ledger of the first ``next_offset`` events of the log ``log_id``."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    format: Literal[1] = 1
    log_id: str
    next_offset: int
    damaged: tuple[str, ...]
    runs: tuple[RunState, ...]


def load(reader: LogReader) -> SavedLedger | None:
    """The saved ledger of a log; None if there is none that can be believed."""
    try:
        saved = SavedLedger.model_validate_json((reader.path / NAME).read_bytes())
    except (OSError, ValidationError):
        return None
    believable = (
        saved.log_id == reader.log_id
        and saved.next_offset <= reader.next_offset
        and saved.damaged == _damaged(reader.path)
    )
    return saved if believable else None


def save(path: Path, log_id: str, next_offset: int, ledger: GapLedger) -> None:
    """Replace the saved ledger. That it cannot be written is no error: it is a cache."""
    saved = SavedLedger(
        log_id=log_id, next_offset=next_offset, damaged=_damaged(path), runs=ledger.state()
    )
    temporary = path / f"{NAME}.new"
    with contextlib.suppress(OSError):
        temporary.write_text(saved.model_dump_json())
        temporary.replace(path / NAME)


def _damaged(path: Path) -> tuple[str, ...]:
    """What `mapfold log recover` has set aside."""
    return tuple(sorted(entry.name for entry in path.iterdir() if entry.suffix == ".damaged"))
