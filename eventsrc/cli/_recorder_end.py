"""How a recording ended: the last lines for people and the numbers for programs.

Said also when the log could not be written any more, for that is when the numbers matter.
"""

from pathlib import Path
from types import TracebackType
from typing import Self

from eventsrc.errors import LogError
from eventsrc.log import LogWriter
from eventsrc.recorder import Recorder, RecorderReport
from eventsrc.words import counted

from ._restart_line import restart_as_json
from ._shell import emit, finish, say


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
