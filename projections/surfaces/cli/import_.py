"""`mapfold import`: messages from files into a log."""

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from eventsrc.base.errors import LogDamaged, MisuseError
from eventsrc.base.text import advised, counted, visible
from eventsrc.envelope.gaps import GapLedger
from eventsrc.envelope.model import RunId
from eventsrc.log import LogReader, LogWriter
from eventsrc.record.gap_history import fold_and_save_ledger
from eventsrc.record.importers import run
from eventsrc.record.importers.bag_streams import BagOptions
from eventsrc.record.importers.known_log import ImportReport
from eventsrc.record.importers.map_yaml import read_map_yaml
from eventsrc.record.importers.opening import check_sources, is_ros
from eventsrc.record.importers.sources import NOT_CHOSEN, Source, TopicChoice
from eventsrc.record.transport.config import check_key

from .bag_text import BagChoice, bag_lines
from .folded_log import classes_advice
from .new_log import DropClassOption, LogStart, NewLogOptions, drop_event, say_camera
from .options import JsonOption, option
from .recorder_text import restart_as_json, say_restart
from .signals import ctrl_c_between_steps
from .terminal import FileBars, emit, finish, say

_MOST_REJECTS: Final = 5
_MOST_TOPICS: Final = 10


def import_(
    *,
    log: Annotated[
        Path, typer.Argument(metavar="LOG", help="The log to append to; created if there is none.")
    ],
    files: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="FILE",
            help="JSON lines (plain or gzip), logger records, MCAP files, bags of ROS 2, other "
            "logs; - is stdin.",
        ),
    ] = None,
    key: Annotated[str, option("KEY", "Key for messages without one.")] = run.DEFAULT_KEY,
    map_: Annotated[
        Path | None,
        option(
            "FILE",
            "The map.yaml of a map server, appended before the files; its walls apply from"
            " there on.",
            "--map",
        ),
    ] = None,
    floor: Annotated[
        str | None, option("NAME", "The floor of the map of --map, as in the envelopes' `floor`.")
    ] = None,
    topic: Annotated[
        list[str] | None,
        option("GLOB", "Only topics (keys) that match this, such as 'tb/*'; may be repeated."),
    ] = None,
    new_log: NewLogOptions,
    drop_class: DropClassOption = None,
    choice: BagChoice,
    json_: JsonOption = False,
) -> None:
    """Append recorded envelopes and occupancy maps to a log, in the order of the files, but for
    what is in it already.

    From a bag of ROS 2 (a folder, or its .db3 or .mcap file) detections become envelopes with their
    poses, and occupancy grids become maps; needs the extra mapfold[ros]. Which topics are used
    follows from their types and names, unless an option names them.

    A message that is neither a valid envelope nor an occupancy grid is kept with its bytes and the
    reason under mapfold/rejected, and the command exits with 3. Messages of an MCAP file that were
    meant for something else are passed over and counted; if nothing is left, it exits with 3, too.
    Ctrl-C keeps the events appended so far and prints how far the import got.
    """
    names = files or []
    if "" in names:
        raise MisuseError("a FILE is empty; give the path of a file, or - for stdin")
    if not names and map_ is None:
        raise MisuseError("nothing to import; give a FILE, or a map by --map")
    check_sources(names)
    check_key(key, "--key")
    if floor is not None and map_ is None:
        raise MisuseError(f"--floor {visible(floor)} is for a map; give one by --map, too")
    topics = TopicChoice.of(topic or ())
    given_map = None if map_ is None else read_map_yaml(map_, floor)
    bags = choice.options()
    new_log.check()
    drops = drop_event(drop_class)
    has_ros = any(map(is_ros, names))
    rejects = _RejectPrinter()
    try:
        with LogWriter(log, fsync=run.IMPORT_FSYNC, imported=True) as writer:
            say_restart(log, writer)
            start = LogStart.of(log, writer, new_log, is_ros=has_ros, drops=drops)
            ledger = _known_keyframes(log)
            with FileBars() as bars, ctrl_c_between_steps() as step, start.said_on_error(writer):
                report = run.import_files(
                    writer,
                    names,
                    key=key,
                    progress=lambda source: _show(bars, source),
                    on_reject=rejects.say,
                    step=step,
                    given_map=given_map,
                    commands=start.for_import(),
                    topics=topics,
                    bags=bags,
                    ledger=ledger,
                )
    except run.ImportInterrupted as interrupted:
        rejects.say_rest()
        say(_kept(log, interrupted))
        start.say_recorded(writer, as_source=interrupted.report.began_as_source)
        say_camera(log, interrupted.report.first_offset)
        raise
    rejects.say_rest()
    if json_:
        emit({"log": str(log), **_as_json(report), **restart_as_json(writer)})
    for bag in report.bags:
        for line in bag_lines(bag):
            say(line)
    if not report.bags and bags != BagOptions():
        say(
            "no bag of ROS 2 among the files: --detections and the other options for bags are not"
            " used"
        )
    start.say(as_source=report.began_as_source)
    say_camera(log, report.first_offset)
    say(_summary(log, report))
    for line in _passed_over(log, report):
        say(line)
    useless = any(bag.is_useless for bag in report.bags)
    finish(findings=report.rejected > 0 or report.imported_nothing or useless)


def _known_keyframes(log: Path) -> GapLedger[RunId] | None:
    """The keyframes that the log has; None if it is damaged, which does not end the import."""
    try:
        with LogReader(log) as reader:
            return fold_and_save_ledger(reader, note=say)
    except LogDamaged as error:
        say(f"keyframes that the log has already are not counted: {error}")
        return None


def _as_json(report: ImportReport) -> dict[str, Any]:
    """The report as JSON; ``bags`` and such only where there is something to say."""
    document = asdict(report)
    document["dropped"] = report.dropped._asdict() if any(report.dropped) else None
    for name in ("bags", "began_as_source", "numbered_classes", "dropped"):
        if not document[name]:
            del document[name]
    return document


class _RejectPrinter:
    """Prints the first few rejections as they come, and the number of the others."""

    def __init__(self) -> None:
        self._count = 0

    def say(self, place: str, reason: str) -> None:
        self._count += 1
        if self._count <= _MOST_REJECTS:
            say(visible(f"{place}: rejected: {reason}"))

    def say_rest(self) -> None:
        if self._count > _MOST_REJECTS:
            say(f"… and {self._count - _MOST_REJECTS:,} more rejected")


def _kept(log: Path, interrupted: run.ImportInterrupted) -> str:
    report = interrupted.report
    if interrupted.place is None:
        return f"{log}: nothing was imported"
    kept = counted(report.next_offset - report.first_offset, "event")
    return (
        f"{log}: kept {kept}, offsets {report.first_offset} to {report.next_offset - 1}, up to "
        f"{interrupted.place}; import it again to go on: what is in the log is passed over"
    )


def _summary(log: Path, report: ImportReport) -> str:
    parts = [f"imported {counted(report.accepted, 'envelope')} into {log}"]
    if report.repeated:
        new = report.accepted - report.repeated
        parts[0] += f" ({new:,} new, {report.repeated:,} of keyframes that it has already)"
    if report.next_offset > report.first_offset:
        parts.append(f"offsets {report.first_offset} to {report.next_offset - 1}")
    if report.maps:
        parts.insert(1, counted(report.maps, "map"))
    if report.verbatim:
        parts.append(f"{counted(report.verbatim, 'verbatim message')} taken over")
    if report.system:
        parts.append(f"{counted(report.system, 'event')} of mapfold's own taken over")
    if report.dropped.detections:
        parts.append(f"{counted(report.dropped.detections, 'detection')} dropped by class")
    if report.dropped.crops:
        parts.append(f"{counted(report.dropped.crops, 'crop')} dropped")
    if report.skipped:
        parts.append(f"{counted(report.skipped, 'message')} passed over")
    parts.append(f"{report.rejected} rejected")
    hint = (
        f"; `{advised('log', 'cat', log, '--key', 'mapfold/rejected')}` shows them"
        if report.rejected
        else ""
    )
    return ", ".join(parts) + hint


def _passed_over(log: Path, report: ImportReport) -> Iterator[str]:
    for each in report.passed_over[:_MOST_TOPICS]:
        yield visible(f"passed over: {each.topic}: {counted(each.count, 'message')}, {each.what}")
    if len(report.passed_over) > _MOST_TOPICS:
        yield f"… and {counted(len(report.passed_over) - _MOST_TOPICS, 'topic')} more"
    chosen_away = any(each.what == NOT_CHOSEN for each in report.passed_over)
    if report.imported_nothing and not report.rejected and chosen_away:
        yield "nothing was imported: --topic chooses none of these topics"
    elif report.imported_nothing and not report.rejected:
        yield (
            "nothing was imported: no message is an envelope (docs/recording.md); --topic GLOB "
            "imports a topic of JSON nevertheless and reports what is wrong with each message"
        )
    if report.numbered_classes:
        yield classes_advice(log)
    is_unchanged = report.first_offset == report.next_offset
    if is_unchanged and not (report.skipped or report.bags):
        yield "what was given has no messages"
    if (is_unchanged and report.known) or (report.accepted and report.accepted == report.repeated):
        labels, settings = (
            advised("edit", log, *words)
            for words in (("relabel", "--labels", "FILE"), ("use-settings", "--preset", "NAME"))
        )
        yield visible(
            "nothing is new: the first recording of a keyframe counts, so only other keyframes add"
            f" to it; `{labels}` names its classes, `{settings}` changes the rules of the map"
        )


def _show(bars: FileBars, source: Source) -> None:
    bars.show(id(source), source.name, source.bytes_read(), source.size_bytes)
