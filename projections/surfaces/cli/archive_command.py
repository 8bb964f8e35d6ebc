"""`mapfold log archive` and `log restore`: a log in object storage, and back."""

from dataclasses import asdict
from typing import Annotated, Final

import typer

from eventsrc.base.errors import ArchiveError, MapfoldError, MisuseError
from eventsrc.base.object_store import ObjectStore
from eventsrc.base.progress import report_progress
from eventsrc.base.text import counted
from eventsrc.envelope.model import FIRST_OFFSET, Offset
from eventsrc.log import LogReader
from eventsrc.log.archive import Archive, Archived, archive_kept, archive_log
from eventsrc.log.away import restore_log
from eventsrc.log.verify import verify_archive
from projections.map.parsing import read_corrections
from projections.store.history_recorder import HistoryRecorder
from projections.store.timeline_cache import TimelineCache

from .event_text import finding_text
from .folded_log import LogArgument, settings_from
from .options import JsonOption
from .signals import stop_on_signals
from .terminal import display, emit, finish, say

UrlArgument = Annotated[
    str,
    typer.Argument(
        metavar="URL", help="s3://BUCKET/PREFIX, gs://…, az://CONTAINER/PREFIX or file:///FOLDER."
    ),
]
_POLL_S: Final = 2.0
_LONGEST_PAUSE_S: Final = 60.0


def archive(
    log: LogArgument,
    url: UrlArgument,
    follow: Annotated[
        bool, typer.Option("--follow", help="Go on beside a recorder, until Ctrl-C.")
    ] = False,
    verify: Annotated[
        bool,
        typer.Option(
            "--verify",
            help="Read the archive whole, and compare hashes and chain; LOG need not be there.",
        ),
    ] = False,
    no_fold: Annotated[
        bool, typer.Option("--no-fold", help="Put the events only, not what is folded from them.")
    ] = False,
    json_: JsonOption = False,
) -> None:
    """Copy a log into object storage: each sealed segment, and the kept history of its map.

    Objects are put only if they are not there, read back, and then named in the manifest. Killed
    at any moment, it goes on when run again. Credentials are found as the vendor's tools find them.
    """
    if verify:
        if follow or no_fold:
            raise MisuseError("--verify changes nothing: give it without --follow and --no-fold")
        _verify(url, json_=json_)
        return
    store = ObjectStore(url, make=True)
    if follow:
        _follow(log, store, fold=not no_fold)
        return
    done = archive_log(log, store, note=say)
    folded = None if no_fold else _put_fold(log, store, Offset(done.events))
    if json_:
        emit({"url": store.url, **asdict(done), "folded_bytes": folded})
    else:
        _say_archived(log, store, done)


def _say_archived(log: LogArgument, store: ObjectStore, done: Archived) -> None:
    added = counted(done.added_segments, "segment")
    replaced = f", replaced {done.replaced_segments:,}" if done.replaced_segments else ""
    say(
        f"{log}: put {added}, {done.added_bytes:,} bytes{replaced}; {store.url} has"
        f" {counted(done.events, 'event')} in {counted(done.segments, 'segment')}"
    )
    if done.not_sealed:
        say(f"{log}: the growing segment is archived when it is full or the recorder stops")


def _put_fold(log: LogArgument, store: ObjectStore, end: Offset) -> int | None:
    """Archive the kept history of the first ``end`` events under the settings of the log; returns
    the bytes put. A log that cannot be folded is archived without: None."""
    try:
        with LogReader(log) as reader:
            corrections = read_corrections(reader, end)
            settings = settings_from(None, None, corrections)
            cache = TimelineCache(reader, settings, corrections, say)
            HistoryRecorder(reader, settings, corrections, cache, _report_fold).up_to(end)
            names = cache.names_before(end)
    except ArchiveError:
        raise
    except MapfoldError as error:
        say(f"{log}: archived without a fold: {error}")
        return None
    return archive_kept(log, store, names)


def _report_fold(done: int, total: int) -> None:
    report_progress("folding", done, total)


def _follow(log: LogArgument, store: ObjectStore, *, fold: bool) -> None:
    """Archive each segment once it is sealed. A store that does not answer is asked again, ever
    more rarely: what is not archived stays in the log."""
    folded, pause_s = FIRST_OFFSET, _POLL_S
    with stop_on_signals() as stop:
        while True:
            try:
                done = archive_log(log, store, note=say)
                if done.added_segments or done.replaced_segments:
                    _say_archived(log, store, done)
                if fold and (done.events > folded + folded // 10 or done.replaced_segments):
                    _put_fold(log, store, Offset(done.events))
                    folded = Offset(done.events)
                pause_s = _POLL_S
            except ArchiveError as error:
                pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)
                say(f"mapfold: {error}; trying again in {pause_s:.0f} s")
            if stop.wait(pause_s):
                return


def _verify(url: str, *, json_: bool) -> None:
    result = verify_archive(ObjectStore(url))
    if json_:
        emit(asdict(result))
    else:
        for finding in result.findings:
            display(finding_text(finding))
    size = f"{counted(result.events, 'event')} in {counted(result.segments, 'segment')}"
    found = counted(len(result.findings), "finding") if result.findings else "all good"
    say(f"{result.url}: {size}, {result.size_bytes:,} bytes: {found}")
    for name in result.unnamed:
        say(f"{result.url}/{name}: no entry of the manifest names it: an archiver was killed there")
    finish(findings=bool(result.findings))


def restore(url: UrlArgument, log: LogArgument, json_: JsonOption = False) -> None:
    """Bring a log back from its archive, byte for byte, into a new folder.

    Killed at any moment, it goes on when run again. It never writes over another log, nor over one
    that was recorded on.
    """
    done = restore_log(Archive(ObjectStore(url)), log)
    if json_:
        emit({"url": url, "path": str(log), **asdict(done)})
        return
    fetched = counted(done.fetched_segments, "segment")
    say(
        f"{log}: fetched {fetched}, {done.fetched_bytes:,} bytes; it has"
        f" {counted(done.events, 'event')} in {counted(done.segments, 'segment')}"
    )
