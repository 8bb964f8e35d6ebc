"""`mapfold log archive`, `log restore`, `log retain`: a log in object storage, and back."""

import re
from dataclasses import asdict
from typing import Annotated, Final

import typer

from eventsrc.base.errors import ArchiveError, MapfoldError, MisuseError
from eventsrc.base.machine import system_clock
from eventsrc.base.object_store import ObjectStore
from eventsrc.base.progress import report_progress
from eventsrc.base.text import counted
from eventsrc.envelope.model import FIRST_OFFSET, Offset
from eventsrc.log import LogReader
from eventsrc.log.archive import Archive, Archived, NothingSealed, archive_log
from eventsrc.log.archived_history import archive_kept
from eventsrc.log.away import restore_log, retain_log
from eventsrc.log.seek import resolve_start
from eventsrc.log.verify import verify_archive

from .composition import log_of
from .event_text import finding_text
from .folded_log import LogArgument, point, settings_from
from .options import JsonOption, option
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
    from projections.map.parsing import read_corrections
    from projections.store.history_recorder import HistoryRecorder
    from projections.store.kept_files import spans_of
    from projections.store.timeline_cache import TimelineCache

    try:
        with LogReader(log) as reader:
            corrections = read_corrections(reader, end)
            settings = settings_from(None, None, corrections)
            cache = TimelineCache(reader, settings, corrections, say)
            HistoryRecorder(reader, settings, corrections, cache, _report_fold).up_to(end)
            spans = {name: spans_of(cache.folder / name) for name in cache.names_before(end)}
    except ArchiveError:
        raise
    except MapfoldError as error:
        say(f"{log}: archived without a fold: {error}")
        return None
    return archive_kept(log, store, spans)


def _report_fold(done: int, total: int) -> None:
    report_progress("folding", done, total)


def _follow(log: LogArgument, store: ObjectStore, *, fold: bool) -> None:
    """Archive each segment once it is sealed. A store that does not answer is asked again, ever
    more rarely: what is not archived stays in the log."""
    say(f"following {log} until Ctrl-C: each segment is archived when it is sealed")
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
            except NothingSealed:
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


def restore(
    url: UrlArgument,
    log: LogArgument,
    at: Annotated[str | None, option("W", "Only up to here, by whole segments.", "--at")] = None,
    from_: Annotated[
        str, option("W", "From here on; earlier segments stay in the archive only.", "--from")
    ] = "0",
    to: Annotated[str, option("W", "As --at.", "--to")] = "end",
    json_: JsonOption = False,
) -> None:
    """Bring a log back from its archive, byte for byte, into a new folder.

    Killed at any moment, it goes on when run again. It never writes over another log, nor over one
    that was recorded on. A log that `mapfold log retain` has thinned out gets its segments back.
    """
    if at is not None and (from_, to) != ("0", "end"):
        raise MisuseError("--at stands for --from 0 --to W: give one of them")
    from projections.postgres.embedded import mapfold_home  # here: `log archive` needs none

    if log.parent == mapfold_home() / "archives":
        raise MisuseError("LOG is a URL, too: restore into a folder")
    archive = Archive(ObjectStore(url))
    if (from_, at or to) == ("0", "end"):
        done = restore_log(archive, log)
    else:
        with LogReader(log_of(url)) as reader:
            start, until = resolve_start(reader, from_), point(reader, at or to)
        if start > until:
            raise MisuseError(f"--from {from_} (offset {start}) is after --to {to} ({until})")
        done = restore_log(archive, log, start=start, until=until)
    if json_:
        emit({"url": url, "path": str(log), **asdict(done)})
        return
    fetched = counted(done.fetched_segments, "segment")
    say(
        f"{log}: fetched {fetched}, {done.fetched_bytes:,} bytes; it has"
        f" {counted(done.events, 'event')} in {counted(done.segments, 'segment')}"
    )


_DAY_S: Final = 86_400
_UNITS: Final = {"h": 3_600, "d": _DAY_S, "w": 7 * _DAY_S}


def retain(
    log: LogArgument,
    keep: Annotated[
        str | None, option("TIME", "Keep what was logged in this time: 36h, 30d, 8w.")
    ] = None,
    keep_bytes: Annotated[
        int | None, option("N", "Keep the newest segments that take N bytes.", min=0)
    ] = None,
    json_: JsonOption = False,
) -> None:
    """Delete the oldest segments of a log here, once the archive was compared with them.

    Each is read in the archive just before. The log remembers where they are: what needs one of
    them fetches what it reads. The last sealed segment stays.
    """
    if (keep is None) == (keep_bytes is None):
        raise MisuseError("say what to keep: --keep 30d, or --keep-bytes N")
    before_ns = None if keep is None else system_clock() - _seconds(keep) * 1_000_000_000
    done = retain_log(log, before_ns=before_ns, keep_bytes=keep_bytes)
    if json_:
        emit({"path": str(log), **done._asdict()})
        return
    say(
        f"{log}: deleted {counted(done.away_segments, 'segment')}, {done.away_bytes:,} bytes, here;"
        f" {counted(done.segments, 'sealed segment')}, {done.size_bytes:,} bytes, kept; the last"
        " one stays whatever its age"
    )


def _seconds(text: str) -> int:
    found = re.fullmatch(r"([0-9]{1,6})([hdw])", text)
    if found is None:
        raise MisuseError(f"--keep {text!r} is no time; try 36h, 30d or 8w")
    return int(found[1]) * _UNITS[found[2]]
