"""Importing: from files into a log, every message through the same door as the recorder's.

Importing only appends. Import the same file twice and the log holds it twice; the fold takes a
keyframe it has seen for a duplicate, so the map is the same.
"""

import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from eventsrc.append import append_payload
from eventsrc.envelope import Offset
from eventsrc.errors import MisuseError
from eventsrc.ingest import Rejected
from eventsrc.log import FsyncPolicy, LogWriter
from eventsrc.system_events import LOSS_KEY, REJECTED_KEY

from .json_lines import Imported, JsonLines, Source
from .mcap_files import MCAP_MAGIC, McapFile, OtherLog

DEFAULT_KEY = "tb/detections"
STDIN = "-"
LAZY_COMMIT = FsyncPolicy(interval_ns=500_000_000, max_events=4096)
"""The source can be read again, so nothing hangs on how soon an event is synced."""

_PROGRESS_EVERY = 64

Progress = Callable[[Source], None]
OnReject = Callable[[str, str], None]
"""Takes where a message stands (``run.jsonl: line 17``) and why it is no envelope."""


@dataclass(frozen=True, slots=True)
class ImportReport:
    """What an import did. ``first_offset`` to before ``next_offset`` is what it appended."""

    accepted: int
    rejected: int
    system: int
    """Rejects and losses of another mapfold log, taken over as they were."""
    skipped: int
    first_offset: Offset
    next_offset: Offset


class ImportCut(KeyboardInterrupt):
    """Ctrl-C. ``report`` says what is in the log, synced; ``place`` where its last message stands,
    None when there is none."""

    def __init__(self, report: ImportReport, place: str | None) -> None:
        super().__init__()
        self.report = report
        self.place = place


def import_files(
    writer: LogWriter,
    names: Sequence[str],
    *,
    key: str = DEFAULT_KEY,
    progress: Progress | None = None,
    on_reject: OnReject | None = None,
    step: AbstractContextManager[object] | None = None,
) -> ImportReport:
    """Append every message of ``names`` in order. Messages that name no key get ``key``.

    ``step`` is entered for each message: what holds Ctrl-C back in it makes `ImportCut` exact.
    """
    run = _Import(writer, key, on_reject or (lambda _place, _reason: None))
    try:
        with ExitStack() as files:
            for name in names:
                source = open_source(name, files)
                for number, record in enumerate(source.records()):
                    with step or nullcontext():
                        run.take(source, record)
                    if progress is not None and number % _PROGRESS_EVERY == 0:
                        progress(source)
                run.skipped += source.skipped
    except KeyboardInterrupt:
        raise ImportCut(run.report(), run.place) from None
    return run.report()


class _Import:
    """What has been appended so far, and from where the last of it came."""

    def __init__(self, writer: LogWriter, key: str, on_reject: OnReject) -> None:
        self._writer = writer
        self._key = key
        self._on_reject = on_reject
        self._first = writer.next_offset
        self._last: tuple[Source, int | None] | None = None
        self.accepted = self.rejected = self.system = self.skipped = 0

    def take(self, source: Source, record: Imported) -> None:
        """Append one message."""
        if record.key == REJECTED_KEY or record.key == LOSS_KEY:
            self._take_over(record.key, record)
        else:
            self._append(source, record)
        self._last = source, source.at

    def _take_over(self, key: str, record: Imported) -> None:
        self._writer.append(
            key, record.payload, logged_ns=record.logged_ns, stamp_ns=record.stamp_ns
        )
        self.system += 1

    def _append(self, source: Source, record: Imported) -> None:
        outcome = append_payload(
            self._writer, record.key or self._key, record.payload, logged_ns=record.logged_ns
        )
        if isinstance(outcome, Rejected):
            self.rejected += 1
            self._on_reject(f"{source.name}: {source.unit} {source.at}", outcome.reason)
        else:
            self.accepted += 1

    @property
    def place(self) -> str | None:
        """``line 17 of run.jsonl``."""
        if self._last is None:
            return None
        source, at = self._last
        return f"{source.unit} {at} of {source.name}"

    def report(self) -> ImportReport:
        """All of it, synced."""
        counts = (self.accepted, self.rejected, self.system, self.skipped)
        return ImportReport(*counts, self._first, self._writer.sync())


def check_sources(names: Sequence[str]) -> None:
    """MisuseError for the first that is out of reach, before a log is made for nothing."""
    for name in names:
        if name == STDIN:
            continue
        try:
            Path(name).stat()
        except FileNotFoundError:
            raise MisuseError(f"{name}: no such file; check the path") from None
        except OSError as error:
            raise MisuseError(f"{name}: {error.strerror or error}; check the path") from None


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
