"""`mapfold log redact`: erase detections or keyframes from a log, and from what is made of it."""

import contextlib
import secrets
import shutil
import uuid
from bisect import bisect_right
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from eventsrc.base.errors import MapfoldError, MisuseError
from eventsrc.base.text import advised, counted, visible
from eventsrc.log import LogReader, LogWriter, cache_folder, cache_sizes
from eventsrc.log.durable_files import sync_directory
from eventsrc.log.redact import Pending, Redactor, end_of, redactions_of, staging_folder
from eventsrc.log.seek import time_of
from eventsrc.record.gap_history import delete_ledger
from eventsrc.record.redaction import Erasure, Selection

from .folded_log import LogArgument
from .options import Databases, JsonOption, LiveDbOption, VectorsOption, option, user_at_host
from .terminal import emit, say

_NOT_REACHED: Final = (
    "not reached: exports, pictures and copies made before; archives, until `log archive` is run"
    " again; backups; spools of robots; programs that read the log now, until they are started"
    " again; blocks of the disk that the old files had"
)


def redact(
    log: LogArgument,
    det: Annotated[
        list[str] | None, option("ID", "This detection; may be repeated.", "--det")
    ] = None,
    run: Annotated[
        list[str] | None,
        option("RUN", "Only of this run; its keyframes whole without --det and --class.", "--run"),
    ] = None,
    class_: Annotated[
        list[str] | None,
        option("CLASS", "Detections of this class; may be repeated.", "--class"),
    ] = None,
    before: Annotated[
        str | None, option("TIME", "Only what is stamped before this ISO time.", "--before")
    ] = None,
    crops_only: Annotated[
        bool, typer.Option("--crops-only", help="Only the crops and pictures.")
    ] = False,
    reason: Annotated[str, option("TEXT", "Why; part of the log.", "--reason")] = "",
    issued_by: Annotated[
        str | None,
        option("USER@HOST", "Who redacts [default: your user@host].", "--issued-by"),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print what would go and change nothing.")
    ] = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="Only go on with a redaction that was killed.")
    ] = False,
    db: LiveDbOption = None,
    vector_db: VectorsOption = None,
    json_: JsonOption = False,
) -> None:
    """Erase detections or keyframes: payloads become tombstones at the same offsets, and the
    history beside the log, crops, re-embedded vectors and, with --db, the databases go with them.

    What is selected must fit --det, --run, --class and --before, as far as they are given. Begin
    with --dry-run. Killed at any moment, it goes on with --resume, or with the next recorder.
    docs/keeping.md says what it cannot reach.
    """
    selection = _selection(det, run, class_, before, crops_only=crops_only)
    if resume and selection:
        raise MisuseError("--resume goes on with what was selected; give it alone")
    if not (resume or selection):
        raise MisuseError("nothing is selected; give --det, --run, --class or --before")
    if dry_run:
        with LogReader(log) as reader:
            erasure = _erasure(reader, selection)
            bases = [segment.base for segment in reader.segments]
        hit = {bisect_right(bases, offset) for offset in erasure.changed}
        _say_plan(log, erasure, len(hit), as_json=json_)
        return
    if not (resume or reason.strip()):
        raise MisuseError("--reason TEXT is missing: say why, for those who read the log later")
    LogReader(log).close()  # before a writer would make the folder
    databases = None if db is None else Databases(db=db, vector_db=vector_db)
    went_on = _go_on(log, databases)
    if resume:
        say(f"{log}: {'finished what was begun' if went_on else 'no redaction was begun'}")
        for line in _left(log, db) if went_on else ():
            say(line)
        return
    erased = _erase(log, selection, reason, issued_by or user_at_host(), _words(databases))
    if erased is None:
        say(f"{log}: nothing of that is in the log")
        return
    _go_on(log, databases)
    if json_:
        emit({"redaction_id": erased.redaction_id, **_document(erased)})
    say(f"{log}: redaction {erased.redaction_id}: {_counts_text(erased)}")
    for line in _left(log, db):
        say(line)


def _selection(
    det: list[str] | None,
    run: list[str] | None,
    class_: list[str] | None,
    before: str | None,
    *,
    crops_only: bool,
) -> Selection:
    before_ns = None if before is None else time_of(before)
    if before is not None and before_ns is None:
        raise MisuseError(f"--before {visible(before)[:80]}: give an ISO time, as 2026-03-24")
    if not all(name.strip() for names in (det, run, class_) for name in names or ()):
        raise MisuseError("an empty --det, --run or --class names nothing; leave it out")
    det_ids, runs, classes = (frozenset(each or ()) for each in (det, run, class_))
    return Selection(det_ids, runs, classes, before_ns, before or "", crops_only)


def _erasure(reader: LogReader, selection: Selection) -> Erasure:
    from projections.map.parsing import read_corrections  # here: `log cat` needs no fold

    labels = read_corrections(reader).labels
    return Erasure.of(reader, selection, uuid.uuid4().hex, labels)


def _erase(
    log: Path, selection: Selection, reason: str, issued_by: str, due: list[str]
) -> Erasure | None:
    """Stage and commit; None if the selection has nothing in the log."""
    with Redactor(log) as redactor:
        with LogReader(log) as reader:
            erasure = _erasure(reader, selection)
        if not erasure.changed:
            return None
        salt = secrets.token_bytes(32)
        changes = redactor.stage(erasure.decide, salt)
        about: dict[str, object] = {
            "redaction_id": erasure.redaction_id,
            "issued_by": issued_by,
            "reason": reason,
            "selection": str(selection),
            "salt": salt.hex(),
            "digest_before": _digest(log),
            "digest_after": _digest(staging_folder(log)),
        }
        redactor.commit(redactions_of(changes, about), end_of(log), due)
    return erasure


def _digest(log: Path) -> str | None:
    """The digest of a log's map; None if it cannot be folded."""
    from projections.fold.map_errors import FoldError  # here: `log cat` needs no fold
    from projections.fold.settings import Settings
    from projections.map.digest import map_digest
    from projections.map.fold import fold_log
    from projections.map.parsing import read_corrections

    with LogReader(log) as reader:
        try:
            corrections = read_corrections(reader)
            settings = corrections.settings or Settings()
            return map_digest(fold_log(reader, settings, corrections=corrections)[1])
        except FoldError as error:
            say(f"{log}: no digest, since the log cannot be folded: {error}")
            return None


def _go_on(log: Path, databases: Databases | None) -> bool:
    """Finish a redaction that was begun, in the log and in what is made of it; whether there was
    one. Afterwards every segment is sealed."""
    with LogWriter(log):
        pass  # goes on with it, and seals
    pending = Pending.of(log)
    if pending is None:
        return False
    delete_ledger(log)
    with contextlib.suppress(FileNotFoundError):
        shutil.rmtree(cache_folder(log))
    sync_directory(cache_folder(log).parent)
    if databases is not None:
        _rebuild(log, databases)
    if pending.due and _words(databases) != pending.due:
        again = advised(
            "log", "redact", log, "--resume", *pending.due, without=["--db", "--vector-db"]
        )
        raise MapfoldError(
            f"{log}: a redaction is not finished: databases that it named have rows of what it"
            f" erased: run `{again}`, or, if they are gone for good, delete {staging_folder(log)}"
        )
    pending.finish()
    return True


def _words(databases: Databases | None) -> list[str]:
    """The options that name databases, without passwords."""
    if databases is None:
        return []
    from projections.postgres.connection import url_without_secrets  # here: few need the drivers

    named = {"--db": databases.db, "--vector-db": databases.vector_db}
    given = {name: url for name, url in named.items() if url is not None}
    return [
        word
        for name, url in given.items()
        for word in (name, url_without_secrets(url) if url else "")
    ]


def _rebuild(log: Path, databases: Databases) -> None:
    """Make the rows of the databases again, from the log as it is."""
    # Imported here: few redactions need the drivers.
    from projections.fold.settings import Settings
    from projections.map.parsing import read_corrections
    from projections.postgres import rebuild
    from projections.postgres.rebuild import give_up_replaced

    with LogReader(log) as reader:
        settings = read_corrections(reader).settings or Settings()
    with databases.opened() as targets:
        rebuild(log, targets, settings)
        for line in give_up_replaced(targets):
            say(line)


def _document(erasure: Erasure) -> dict[str, Any]:
    return {
        "selection": str(erasure.selection),
        "detections": len(erasure.det_ids),
        **{name.replace(" ", "_"): count for name, count in sorted(erasure.counts.items())},
    }


def _counts_text(erasure: Erasure) -> str:
    parts = [counted(len(erasure.det_ids), "detection")]
    parts += [f"{count:,} {name}" for name, count in sorted(erasure.counts.items())]
    return ", ".join(parts)


def _say_plan(log: Path, erasure: Erasure, segments: int, *, as_json: bool) -> None:
    if as_json:
        emit({**_document(erasure), "segments": segments})
    events = f"{counted(len(erasure.changed), 'event')} in {counted(segments, 'segment')}"
    say(f"{log}: {events} would change: {_counts_text(erasure)}; nothing is changed")
    for folder, size in cache_sizes(log):
        say(f"{folder.name}: {size:,} bytes of kept histories and folds would go")
    say(_NOT_REACHED)


def _left(log: Path, db: str | None) -> Iterator[str]:
    """Lines on what is not reached."""
    aside = [p.name for p in sorted(log.iterdir()) if ".mcap." in p.name]
    if aside:
        yield f"{log}: {', '.join(aside)} may hold it; delete them"
    if db is None:
        yield "databases have it until they are rebuilt; --db URL does so"
    yield _NOT_REACHED
