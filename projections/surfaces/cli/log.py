"""The commands of `mapfold log`."""

import contextlib
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from eventsrc.base.errors import LogError, MisuseError
from eventsrc.base.text import counted, visible
from eventsrc.envelope.model import FIRST_OFFSET, Offset
from eventsrc.log import (
    Event,
    LogReader,
    SegmentRecovery,
    Unreadable,
    Verification,
    cache_sizes,
    recover_log,
    verify_log,
)
from eventsrc.log.reader import OnGap
from eventsrc.log.recover import DEFAULT_MAX_LOSSES
from eventsrc.log.seek import resolve, resolve_start, time_of
from eventsrc.record.log_info import LogInfo, SegmentInfo, log_info

from . import archive_command
from .event_text import event_document, event_line, finding_text, iso_time
from .folded_log import LogArgument
from .new_log import say_camera
from .options import JsonOption, option
from .redact_command import redact
from .terminal import Bar, display, emit, emit_lines, finish, say


class RangeNotes:
    """Notes on what `log cat` showed: events outside the requested times, and keys without events.

    A range between two times is one of offsets: from the first event stamped then or later to the
    last one stamped then or earlier. Where stamps run backwards in between (runs of last year
    imported after this year's), events of other times are inside it.
    """

    def __init__(self, first: str, last: str, keys: Sequence[str]) -> None:
        self._first_ns, self._last_ns = time_of(first), time_of(last)
        self._times = " or ".join(
            f"{side} {text}"
            for side, text, time_ns in (
                ("before", first, self._first_ns),
                ("after", last, self._last_ns),
            )
            if time_ns is not None
        )
        self._missing = dict.fromkeys(keys)
        self._outside = 0

    def watch(self, events: Iterable[Event]) -> Iterable[Event]:
        """Pass ``events`` through, counting what `lines` reports."""
        return self._counted(events) if self._times or self._missing else events

    def _counted(self, events: Iterable[Event]) -> Iterator[Event]:
        for event in events:
            self._missing.pop(event.key, None)
            if event.is_envelope:  # others are stamped when they were written
                self._outside += self._is_outside(event.stamp_ns)
            yield event

    def _is_outside(self, stamp_ns: int) -> bool:
        early = self._first_ns is not None and stamp_ns < self._first_ns
        return early or (self._last_ns is not None and stamp_ns > self._last_ns)

    def lines(self, log: Path) -> Iterator[str]:
        """Lines for people, after the last event."""
        if self._outside:
            verb = "is" if self._outside == 1 else "are"
            yield (
                f"{log}: {counted(self._outside, 'event')} of these {verb} stamped {self._times}: "
                "stamps run backwards in this log; offsets or RUN:KEYFRAME give an exact range"
            )
        if self._missing:
            yield from self._missing_keys(log)

    def _missing_keys(self, log: Path) -> Iterator[str]:
        with contextlib.suppress(LogError):  # a damaged log; what can be read was shown
            there = log_info(log).keys
            for key in self._missing:
                if key not in there:
                    names = ", ".join(map(visible, there)) or "none, as the log is empty"
                    yield f"{log}: no event has the key {key!r}; there are {names}"


log_commands = typer.Typer(help="Inspect, repair and archive a log.", no_args_is_help=True)


@log_commands.command()
def info(log: LogArgument, json_: JsonOption = False) -> None:
    """Show what a log holds: id, segments, offsets, counts by key, rejected, losses, times."""
    report = log_info(log, note=say)
    if json_:
        emit(info_document(report))
    else:
        display(_info_text(report))
    say_camera(log)


def info_document(report: LogInfo) -> dict[str, Any]:
    """The output of `log info --json`: times as nanoseconds, and as ISO 8601."""
    times = ("first_logged", "last_logged", "first_stamp", "last_stamp")
    numbers = {name: getattr(report, f"{name}_ns") for name in times}
    return {
        **asdict(report),
        **{name: None if ns is None else iso_time(ns) for name, ns in numbers.items()},
        "path": str(report.path),
        "segments": [asdict(s) for s in report.segments],
        "caches": {path.name: size for path, size in cache_sizes(report.path)},
    }


def _info_text(report: LogInfo) -> str:
    rows = [
        ("log", f"{report.path} ({report.log_id})"),
        ("events", f"{report.events} in {report.size_bytes:,} bytes"),
        ("rejected", str(report.rejected)),
        ("lost", str(report.lost)),
    ]
    if report.first_logged_ns is not None and report.last_logged_ns is not None:
        rows.append(("logged", _span(report.first_logged_ns, report.last_logged_ns)))
    if report.first_stamp_ns is not None and report.last_stamp_ns is not None:
        rows.append(("stamped", _span(report.first_stamp_ns, report.last_stamp_ns)))
    begun = [segment.begun_ns for segment in report.segments if segment.begun_ns is not None]
    if begun:
        rows.append(("written", _span(begun[0], begun[-1])))
    rows += [("archive", report.archive)] if report.archive is not None else []
    rows += [("key", _key_text(key, report)) for key in report.keys]
    rows += [("segment", _segment_text(segment)) for segment in report.segments]
    rows += [
        ("cache", f"{folder.name}: {size:,} bytes, safe to delete")
        for folder, size in cache_sizes(report.path)
    ]
    return "".join(f"{name:<9} {value}\n" for name, value in rows)


def _key_text(key: str, report: LogInfo) -> str:
    formats = f" ({', '.join(report.formats[key])})" if key in report.formats else ""
    return visible(f"{key}: {report.keys[key]}{formats}")


def _segment_text(segment: SegmentInfo) -> str:
    state = "sealed" if segment.sealed else "active"
    state += ", imported" if segment.imported else ""
    state += ", in the archive only" if segment.away else ""
    return (
        f"{segment.name}: {counted(segment.events, 'event')}, {segment.size_bytes:,} bytes, {state}"
    )


def _span(first_ns: int, last_ns: int) -> str:
    if first_ns == last_ns:
        return iso_time(first_ns)
    return f"{iso_time(first_ns)} to {iso_time(last_ns)}"


@log_commands.command()
def cat(
    log: LogArgument,
    from_: Annotated[str, option("W", "Start of the range.", "--from")] = "0",
    to: Annotated[str, option("W", "End of the range.", "--to")] = "end",
    key: Annotated[list[str] | None, option("K", "Only this key; may be repeated.")] = None,
    skip_damage: Annotated[
        bool, typer.Option("--skip-damage", help="Report unreadable offsets and continue (exit 3).")
    ] = False,
    json_: JsonOption = False,
) -> None:
    """Print the events of a log in order, one per line.

    W is an offset, an ISO time, RUN:KEYFRAME or end. An offset of --to is not included; a keyframe
    or a time is, at either end.
    """
    gaps: list[Unreadable] = []

    def note(gap: Unreadable) -> None:
        if any(known.first <= gap.first and gap.last <= known.last for known in gaps):
            return  # reported before, in the search for --from or --to
        gaps.append(gap)
        say(f"{log}: offsets {gap.first} to {gap.last} cannot be read: {gap.reason}")

    with LogReader(log) as reader:
        on_gap = note if skip_damage else None
        start = resolve_start(reader, from_, on_gap=on_gap)
        end = _end(reader, to, start, on_gap)
        last = reader.readable_end if end is None else end
        if start > last:
            raise MisuseError(f"--from {from_} (offset {start}) is after --to {to} (offset {last})")
        notes = RangeNotes(from_, to, key or ())
        events = notes.watch(reader.read(start, end, keys=key or None, on_gap=on_gap))
        if json_:
            emit_lines(map(event_document, events))
        else:
            for event in events:
                display(event_line(event))
    for line in notes.lines(log):
        say(line)
    finish(findings=bool(gaps))


def _end(reader: LogReader, to: str, start: Offset, on_gap: OnGap | None) -> Offset | None:
    """The end of a range from offset ``start`` on. None for the end of the log, and if the search
    for ``to`` met damage: reading then shows the events before the damage."""
    if to == "end":
        return None
    if on_gap is not None:
        return resolve(reader, to, on_gap=on_gap)
    met: list[Unreadable] = []
    try:
        end = resolve(reader, to, on_gap=met.append)
    except MisuseError:
        if not met:
            raise
        end = FIRST_OFFSET  # the point may be among the unreadable events
    if met and met[0].last < start:
        return resolve(reader, to)  # raises LogDamaged
    return None if met else end


@log_commands.command()
def verify(log: LogArgument, json_: JsonOption = False) -> None:
    """Read every byte of a log and report everything that is wrong; exit 3 if anything is.

    Checks magic, CRCs, hash chain, dense offsets and every payload; reports duplicate keyframes,
    clocks that ran backwards, and losses.
    """
    result = verify_log(log)
    if json_:
        emit(verification_document(result))
    else:
        for finding in result.findings:
            display(finding_text(finding))
    for each in result.redactions:
        said = f": {each.reason}" if each.reason else ""
        by = f"{counted(each.payloads, 'payload')} redacted by {each.issued_by}"
        say(visible(f"{log}: {by} ({each.selection}){said}"))
    size = f"{counted(result.events, 'event')} in {counted(result.segments, 'segment')}"
    found = counted(len(result.findings), "finding") if result.findings else "all good"
    say(f"{log}: {size}, {result.size_bytes:,} bytes: {found}")
    finish(findings=bool(result.findings))


def verification_document(result: Verification) -> dict[str, Any]:
    """The output of `log verify --json`."""
    return {**asdict(result), "path": str(result.path)}


log_commands.command()(redact)


@log_commands.command()
def recover(
    log: LogArgument,
    yes: Annotated[bool, typer.Option("--yes", help="Add any number of loss events.")] = False,
    json_: JsonOption = False,
) -> None:
    """Repair a log that is damaged or was left by a crash, keeping everything that can be read.

    Originals in which something recorded is damaged are kept as *.damaged; segments of other logs
    are renamed to *.foreign-LOG_ID, those whose events are in other segments too to *.duplicate;
    wrong names are corrected. Lost offsets become mapfold/loss events; without --yes at most
    100,000 more than the damaged bytes can have held. Exit 0: nothing was lost or out of place, 3:
    something was.
    """
    report = recover_log(log, max_losses=sys.maxsize if yes else DEFAULT_MAX_LOSSES)
    if json_:
        emit({**asdict(report), "path": str(log)})
    for moved in report.moved:
        say(f"{moved.name}: is now {moved.now}: {moved.reason}")
    for segment in report.segments:
        say(_recovery_text(segment))
    say(
        f"{log}: {counted(report.events, 'event')}"
        if report.segments or report.moved
        else f"{log}: nothing to recover"
    )
    finish(findings=report.findings)


def _recovery_text(segment: SegmentRecovery) -> str:
    kept = counted(segment.kept_events, "event")
    parts = [f"{segment.name}: kept {kept} ({segment.kept_bytes:,} bytes)"]
    if segment.lost_events:
        gaps = ", ".join(f"{first} to {last}" for first, last in segment.gaps)
        parts.append(f"lost {counted(segment.lost_events, 'recorded event')} (offsets {gaps})")
    if segment.lost_bytes:
        parts.append(f"left out {segment.lost_bytes:,} bytes")
    if segment.torn_events:
        parts.append(f"with {counted(segment.torn_events, 'event')} never synced")
    if segment.kept_copy:
        parts.append(f"original kept as {segment.kept_copy}")
    return ", ".join(parts)


@log_commands.command()
def spaces(log: LogArgument, json_: JsonOption = False) -> None:
    """Print the embedding spaces of a log: a model, its dimension, and how many detections have a
    vector of it.

    `mapfold reembed` adds vectors of another space; --space NAME maps a log in it.
    """
    from projections.map.parsing import log_spaces

    with LogReader(log) as reader, Bar() as bar:
        found = log_spaces(reader, lambda done, all_: bar.show("reading", done, all_))
    if json_:
        emit(asdict(found))
        return
    bare = f", {found.bare:,} of them recorded without a vector" if found.bare else ""
    display(f"{counted(found.detections, 'detection')}{bare}")
    for each in found.spaces:
        name = "(no name)" if each.model is None else visible(each.model)
        parts = [f"{each.recorded:,} recorded"] if each.recorded else []
        parts += [f"{each.reembedded:,} re-embedded"] if each.reembedded else []
        display(f"  {name}, dimension {each.dim:,}: {', '.join(parts) or 'none'}")


for _command in (archive_command.archive, archive_command.restore, archive_command.retain):
    log_commands.command()(_command)
