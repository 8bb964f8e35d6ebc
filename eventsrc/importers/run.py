"""Importing: from files into a log, every message through the same door as the recorder's.

Importing only appends. Import the same file twice and the log holds it twice; the fold takes a
keyframe it has seen for a duplicate, so the map is the same.
"""

import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from eventsrc.append import append_payload
from eventsrc.errors import MisuseError
from eventsrc.ingest import Rejected
from eventsrc.log import FsyncPolicy, LogWriter
from eventsrc.system_events import LOSS_KEY, REJECTED_KEY

from .json_lines import JsonLines
from .other_logs import MCAP_MAGIC, McapFile, OtherLog
from .record import Imported, Source

DEFAULT_KEY = "tb/detections"
STDIN = "-"
LAZY_COMMIT = FsyncPolicy(interval_ns=500_000_000, max_events=4096)
"""The source can be read again, so nothing hangs on how soon an event is synced."""

_PROGRESS_EVERY = 64

Progress = Callable[[Source], None]


@dataclass(frozen=True, slots=True)
class ImportReport:
    """What an import did. ``first_offset`` to before ``next_offset`` is what it appended."""

    accepted: int
    rejected: int
    system: int
    """Rejects and losses of another mapfold log, taken over as they were."""
    skipped: int
    first_offset: int
    next_offset: int


def import_files(
    writer: LogWriter,
    names: Sequence[str],
    *,
    key: str = DEFAULT_KEY,
    progress: Progress | None = None,
) -> ImportReport:
    """Append every message of ``names`` in order. Messages that name no key get ``key``."""
    first = writer.next_offset
    accepted = rejected = system = skipped = 0
    with ExitStack() as files:
        for name in names:
            source = open_source(name, files)
            for number, record in enumerate(source.records()):
                if record.key == REJECTED_KEY or record.key == LOSS_KEY:
                    _take_over(writer, record.key, record)
                    system += 1
                elif _append(writer, record, key):
                    accepted += 1
                else:
                    rejected += 1
                if progress is not None and number % _PROGRESS_EVERY == 0:
                    progress(source)
            skipped += source.skipped
    return ImportReport(accepted, rejected, system, skipped, first, writer.sync())


def _append(writer: LogWriter, record: Imported, key: str) -> bool:
    outcome = append_payload(writer, record.key or key, record.payload, logged_ns=record.logged_ns)
    return not isinstance(outcome, Rejected)


def _take_over(writer: LogWriter, key: str, record: Imported) -> None:
    writer.append(key, record.payload, logged_ns=record.logged_ns, stamp_ns=record.stamp_ns)


def check_sources(names: Sequence[str]) -> None:
    """MisuseError for the first that is not there, before a log is made for nothing."""
    for name in names:
        if name != STDIN and not Path(name).exists():
            raise MisuseError(f"{name}: no such file; check the path")


def open_source(name: str, files: ExitStack) -> Source:
    """A file by what is in it, a log by being a folder, ``-`` for standard input."""
    if name != STDIN and Path(name).is_dir():
        return OtherLog(Path(name))
    try:
        file, size = _open_file(name, files)
        start = _peek(file)
    except OSError as error:
        raise MisuseError(f"{name}: {error.strerror or error}; check the path") from None
    label = "standard input" if name == STDIN else name
    if start.startswith(MCAP_MAGIC):
        return McapFile(label, file, size)
    return JsonLines(label, file, size, start)


def _open_file(name: str, files: ExitStack) -> tuple[BinaryIO, int | None]:
    if name == STDIN:
        return sys.stdin.buffer, None
    path = Path(name)
    return files.enter_context(path.open("rb")), path.stat().st_size


def _peek(file: BinaryIO) -> bytes:
    data: bytes = file.peek(8)  # type: ignore[attr-defined]
    return data
