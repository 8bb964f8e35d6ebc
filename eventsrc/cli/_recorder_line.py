"""What a recorder says while it records: one line on a terminal, and losses everywhere."""

import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.live import Live
from rich.text import Text

from eventsrc.recorder import RecorderReport

from ._shell import people, say

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
