"""Text and JSON of a recorder: status line, warnings, what was recovered at the start, summary."""

import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from rich.live import Live
from rich.text import Text

from eventsrc.base.errors import LogError
from eventsrc.base.text import advised, counted, visible
from eventsrc.envelope.system_events import LOSS_KEY, REJECTED_KEY
from eventsrc.log import LogWriter
from eventsrc.record.recorder.recorder import Recorder
from eventsrc.record.recorder.writer_thread import RecorderReport

from .terminal import emit, finish, people, say

EVERY_S = 1.0
_FEW_UNSEALED = 3
"""So many unsealed segments are normal; only more are shown."""


class RecorderStatus:
    """The status line and warnings from successive reports of a recorder."""

    def __init__(self, log: Path, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._log = log
        self._clock = clock
        self._at_s = clock()
        self._recorded = self._lost = self._rejected = 0
        self._sealing_error: str | None = None
        self._faults = 0

    def line(self, report: RecorderReport, free_bytes: int) -> str:
        """The status line; the rate is since the previous call."""
        now_s = self._clock()
        events = report.recorded + report.messages + report.crops
        rate = (events - self._recorded) / max(now_s - self._at_s, 1e-9)
        self._at_s, self._recorded = now_s, events
        return (
            f"{rate:,.0f}/s · {report.recorded:,} recorded · {_messages(report)}{_crops(report)}"
            f"{report.rejected:,} rejected · "
            f"{report.lost:,} lost · {report.missing:,} missing · "
            f"queue {report.queue_depth:,} · "
            f"{free_bytes / 1e9:,.1f} GB free{_unsealed(report)}"
        )

    def warnings(self, report: RecorderReport) -> list[str]:
        """A line for each kind of loss that has grown since the previous call."""
        lines = []
        lost = report.queue_full + report.transport_missed
        if lost > self._lost:
            lines.append(
                f"LOST {counted(lost - self._lost, 'message')} (in all {report.queue_full:,} in a "
                f"full queue, {report.transport_missed:,} on the way); "
                f"{_shown_by(self._log, LOSS_KEY)}"
            )
        if report.rejected > self._rejected:
            lines.append(
                f"rejected {counted(report.rejected - self._rejected, 'payload')}; "
                f"{_shown_by(self._log, REJECTED_KEY)}"
            )
        lines += [
            f"SEGMENT GIVEN UP: {fault}; recording goes on in a new segment"
            for fault in report.faults[self._faults :]
        ]
        if report.sealing_error not in (None, self._sealing_error):
            lines.append(f"sealing fails: {report.sealing_error}")
        self._lost, self._rejected = lost, report.rejected
        self._faults = len(report.faults)
        self._sealing_error = report.sealing_error
        return lines


def _shown_by(log: Path, key: str) -> str:
    return f"`{advised('log', 'cat', log, '--key', key)}` shows them"


def _messages(report: RecorderReport) -> str:
    waiting = f" ({report.held:,} wait for their type)" if report.held else ""
    return f"{report.messages:,} of ROS{waiting} · " if report.messages or report.held else ""


def _crops(report: RecorderReport) -> str:
    return f"{counted(report.crops, 'crop')} · " if report.crops else ""


def _unsealed(report: RecorderReport) -> str:
    if report.sealing_error is not None:
        return f" · sealing fails, {report.unsealed:,} unsealed"
    return f" · {report.unsealed:,} unsealed" if report.unsealed > _FEW_UNSEALED else ""


@contextmanager
def show_status(log: Path) -> Iterator[Callable[[RecorderReport], None]]:
    """The ``watch`` function for `Recorder.run`: prints warnings, and on a terminal the status
    line."""
    status = RecorderStatus(log)

    def warn(report: RecorderReport) -> None:
        for line in status.warnings(report):
            say(line)

    if not people.is_terminal:
        yield warn
        return
    with Live(console=people, transient=True, auto_refresh=False) as live:

        def show(report: RecorderReport) -> None:
            warn(report)
            text = status.line(report, shutil.disk_usage(log).free)
            live.update(Text(text, no_wrap=True, overflow="ellipsis"), refresh=True)

        yield show


def say_restart(log: Path, writer: LogWriter) -> None:
    """Print the recovered and the cut-off events, if the last writer did not finish."""
    found = writer.restart
    if not (found.recovered_segments or found.torn_bytes or found.torn_events):
        return
    say(
        f"{log}: the last writer did not finish; recovered "
        f"{counted(found.recovered_segments, 'segment')} with "
        f"{counted(found.recovered_events, 'event')}, cut off "
        f"{counted(found.torn_bytes, 'torn byte')} with "
        f"{counted(found.torn_events, 'event')} that were never recorded"
    )


def restart_as_json(writer: LogWriter) -> dict[str, int]:
    """Counts of what a restart recovered and cut off, for ``--json``."""
    found = writer.restart
    return {
        "recovered_segments": found.recovered_segments,
        "recovered_events": found.recovered_events,
        "torn_bytes": found.torn_bytes,
        "torn_events": found.torn_events,
    }


class RecorderSummary:
    """Prints the last lines of a recording, also when the log could not be written any more.

    A context manager around the recording: `watch` the recorder as soon as there is one, and call
    `finish` at the end.
    """

    def __init__(self, log: Path, *, json: bool) -> None:
        self._log = log
        self._json = json
        self._watched: tuple[LogWriter, Recorder] | None = None

    def watch(self, writer: LogWriter, recorder: Recorder) -> None:
        """Print the numbers of ``recorder`` at the end."""
        self._watched = writer, recorder

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        if self._watched is None or not (error is None or isinstance(error, LogError)):
            return
        writer, recorder = self._watched
        report = recorder.report()
        if report.unwritten:
            say(unwritten_text(report))
        for line in unused_text(report):
            say(line)
        say(summary(self._log, report))
        if self._json:
            emit(as_json(report) | restart_as_json(writer))

    def finish(self) -> None:
        """Exit with 3 if the recorder lost or rejected something."""
        finish(findings=self._watched is not None and not self._watched[1].report().clean)


def unwritten_text(report: RecorderReport) -> str:
    """A line about messages that were received and not written."""
    return (
        f"LOST {counted(report.unwritten, 'message')} that had come in and could not be written, "
        f"{report.queue_depth:,} of them in the queue; robots with a spool send theirs again"
    )


def unused_text(report: RecorderReport) -> list[str]:
    """Lines about messages of ROS that were kept but not used for envelopes."""
    lines = [
        visible(f"{topic}: {counted(count, 'message')} kept that cannot be read: {reason}")
        for topic, count, reason in report.unread
    ]
    if report.untyped:
        lines.append(
            f"{counted(report.untyped, 'message')} kept without a schema, and nothing made of "
            "them: no bridge declared their type"
        )
    if report.unknown_keys:
        lines.append(
            f"{counted(report.unknown_keys, 'message')} left out: their keys match recorded topics"
            " of ROS, but are not the key of one"
        )
    return lines


def summary(log: Path, report: RecorderReport) -> str:
    """The last line of a recording."""
    commands = f"{counted(report.commands, 'command')} of mapfold edit, " if report.commands else ""
    messages = f"{counted(report.messages, 'message')} of ROS, " if report.messages else ""
    left_out = (
        f"{counted(report.dropped.detections, 'detection')} and "
        f"{counted(report.dropped.crops, 'crop')} dropped by class, "
        if any(report.dropped)
        else ""
    )
    crops = f"{counted(report.crops, 'crop')}, " if report.crops else ""
    return (
        f"{log}: {report.recorded:,} recorded, {report.rejected:,} rejected, {report.lost:,} lost, "
        f"{counted(report.missing, 'keyframe')} missing; {left_out}{crops}{messages}{commands}"
        f"{counted(report.next_offset, 'event')} in the log"
    )


def as_json(report: RecorderReport) -> dict[str, Any]:
    """The final numbers, for ``--json``; ``streams`` and ``unknown_keys`` with --ros2dds only."""
    of_ros = {
        "unknown_keys": report.unknown_keys,
        "streams": {topic: asdict(counts) for topic, counts in report.streams},
    }
    return {
        "recorded": report.recorded,
        "rejected": report.rejected,
        "queue_full": report.queue_full,
        "transport_missed": report.transport_missed,
        "commands": report.commands,
        "crops": report.crops,
        "messages": report.messages,
        "untyped": report.untyped,
        "unread": sum(count for _, count, _ in report.unread),
        "unwritten": report.unwritten,
        "lost_from_log": report.lost_from_log,
        "missing": report.missing,
        "next_offset": report.next_offset,
        "unsealed": report.unsealed,
        "sealing_error": report.sealing_error,
        **({"dropped": report.dropped._asdict()} if any(report.dropped) else {}),
        **(of_ros if report.streams else {}),
    }
