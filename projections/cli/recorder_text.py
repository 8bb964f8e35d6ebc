"""What a recorder says while it records: one line on a terminal, and losses everywhere.

What a writer found when it opened a log: one line for people, numbers for programs.

How a recording ended: the last lines for people and the numbers for programs.

Said also when the log could not be written any more, for that is when the numbers matter.
"""

import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Self

from rich.live import Live
from rich.text import Text

from eventsrc.errors import LogError
from eventsrc.log import LogWriter
from eventsrc.recorder import Recorder, RecorderReport
from eventsrc.text import counted

from .terminal import emit, finish, people, say

EVERY_S = 1.0
_FEW_UNSEALED = 3
"""So many segments may wait to be sealed without anybody being told: sealing runs behind."""


class RecorderLine:
    """Turns successive reports into the status line, and speaks up when losses grow."""

    def __init__(self, log: Path, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._log = log
        self._clock = clock
        self._at_s = clock()
        self._recorded = self._lost = self._rejected = 0
        self._sealing_error: str | None = None
        self._faults = 0

    def line(self, report: RecorderReport, free_bytes: int) -> str:
        """The status line; the rate is that since the call before."""
        now_s = self._clock()
        rate = (report.recorded - self._recorded) / max(now_s - self._at_s, 1e-9)
        self._at_s, self._recorded = now_s, report.recorded
        return (
            f"{rate:,.0f}/s · {report.recorded:,} recorded · {report.rejected:,} rejected · "
            f"{report.lost:,} lost · {report.missing:,} missing · "
            f"queue {report.queue_depth:,} · "
            f"{free_bytes / 1e9:,.1f} GB free{_unsealed(report)}"
        )

    def complaints(self, report: RecorderReport) -> list[str]:
        """A line for whatever has grown since the call before."""
        lines = []
        lost = report.queue_full + report.too_large + report.transport_missed
        if lost > self._lost:
            lines.append(
                f"LOST {lost - self._lost} messages ({report.queue_full} in a full queue, "
                f"{report.too_large} too large, {report.transport_missed} on the way, in all); "
                f"see mapfold/loss in {self._log}"
            )
        if report.rejected > self._rejected:
            lines.append(
                f"rejected {report.rejected - self._rejected} payloads; "
                f"see mapfold/rejected in {self._log}"
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


def _unsealed(report: RecorderReport) -> str:
    if report.sealing_error is not None:
        return f" · sealing fails, {report.unsealed:,} unsealed"
    return f" · {report.unsealed:,} unsealed" if report.unsealed > _FEW_UNSEALED else ""


@contextmanager
def watching(log: Path) -> Iterator[Callable[[RecorderReport], None]]:
    """What to give `Recorder.run` as ``watch``."""
    status = RecorderLine(log)

    def complain(report: RecorderReport) -> None:
        for line in status.complaints(report):
            say(line)

    if not people.is_terminal:
        yield complain
        return
    with Live(console=people, transient=True, auto_refresh=False) as live:

        def show(report: RecorderReport) -> None:
            complain(report)
            text = status.line(report, shutil.disk_usage(log).free)
            live.update(Text(text, no_wrap=True, overflow="ellipsis"), refresh=True)

        yield show


def say_restart(log: Path, writer: LogWriter) -> None:
    """Say what was recovered and what was cut off; nothing, if the log was left in order."""
    found = writer.restart
    if not (found.recovered_segments or found.torn_bytes or found.torn_events):
        return
    say(
        f"{log}: the last writer did not finish; recovered "
        f"{counted(found.recovered_segments, 'segment')} with "
        f"{counted(found.recovered_events, 'event')}, cut off "
        f"{counted(found.torn_bytes, 'torn byte')} with "
        f"{counted(found.torn_events, 'event')} that never counted as recorded"
    )


def restart_as_json(writer: LogWriter) -> dict[str, int]:
    """The same for programs."""
    found = writer.restart
    return {
        "recovered_segments": found.recovered_segments,
        "recovered_events": found.recovered_events,
        "torn_bytes": found.torn_bytes,
        "torn_events": found.torn_events,
    }


class RecorderEnd:
    """Wrap it around everything, `watch` the recorder once there is one, and `finish` at last."""

    def __init__(self, log: Path, *, json: bool) -> None:
        self._log = log
        self._json = json
        self._watched: tuple[LogWriter, Recorder] | None = None

    def watch(self, writer: LogWriter, recorder: Recorder) -> None:
        """From here on there is something to tell."""
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
            say(lost_in_queue(report))
        say(summary(self._log, report))
        if self._json:
            emit(as_json(report) | restart_as_json(writer))

    def finish(self) -> None:
        """Exit with 3 when the recorder lost or rejected something."""
        finish(findings=self._watched is not None and not self._watched[1].report().clean)


def lost_in_queue(report: RecorderReport) -> str:
    """What went down with a log that takes no more."""
    return (
        f"LOST {counted(report.unwritten, 'message')} that had come in and could not be written, "
        f"{report.queue_depth:,} of them in the queue; robots with a spool send theirs again"
    )


def summary(log: Path, report: RecorderReport) -> str:
    """The last line for people."""
    return (
        f"{log}: {report.recorded:,} recorded, {report.rejected:,} rejected, {report.lost:,} lost, "
        f"{counted(report.missing, 'keyframe')} missing; "
        f"{counted(report.next_offset, 'event')} in the log"
    )


def as_json(report: RecorderReport) -> dict[str, int | str | None]:
    """The final numbers for programs."""
    return {
        "recorded": report.recorded,
        "rejected": report.rejected,
        "queue_full": report.queue_full,
        "too_large": report.too_large,
        "transport_missed": report.transport_missed,
        "unwritten": report.unwritten,
        "lost_from_log": report.lost_from_log,
        "missing": report.missing,
        "next_offset": report.next_offset,
        "unsealed": report.unsealed,
        "sealing_error": report.sealing_error,
    }
