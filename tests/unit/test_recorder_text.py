"""Status line, warnings and summary of `mapfold record`."""

import dataclasses
from pathlib import Path

from eventsrc.record.recorder.writer_thread import RecorderReport
from projections.surfaces.cli.recorder_text import RecorderStatus, summary

NOTHING = RecorderReport(
    recorded=0,
    rejected=0,
    queue_full=0,
    transport_missed=0,
    missing=0,
    missing_before=0,
    queue_depth=0,
    queue_size=100,
    next_offset=0,
)


def _line(*times_s: float) -> RecorderStatus:
    return RecorderStatus(Path("logs/run-7"), clock=iter(times_s).__next__)


def test_the_rate_is_since_the_previous_line() -> None:
    status = _line(0.0, 2.0, 3.0)
    busy = dataclasses.replace(NOTHING, recorded=5_000, queue_depth=7, missing=2)
    assert status.line(busy, 12_300_000_000) == (
        "2,500/s · 5,000 recorded · 0 rejected · 0 lost · 2 missing · queue 7 · 12.3 GB free"
    )
    assert status.line(busy, 0).startswith("0/s · 5,000 recorded")


def test_a_loss_is_warned_of_once() -> None:
    status = _line(0.0)
    assert status.warnings(NOTHING) == []
    lost = dataclasses.replace(NOTHING, queue_full=5, transport_missed=2)
    (line,) = status.warnings(lost)
    assert line.startswith("LOST 7 messages (in all 5 in a full queue, 2 on the way)")
    assert "logs/run-7" in line
    assert status.warnings(lost) == []
    (line,) = status.warnings(dataclasses.replace(lost, transport_missed=5))
    assert line.startswith("LOST 3 messages (in all 5 in a full queue, 5 on the way)")
    status.warnings(lost)
    (line,) = status.warnings(dataclasses.replace(lost, queue_full=6))
    assert line.startswith("LOST 1 message (in all 6 in a full queue")


def test_rejections_are_warned_of() -> None:
    (line,) = _line(0.0).warnings(dataclasses.replace(NOTHING, rejected=3))
    shown = "`mapfold log cat logs/run-7 --key mapfold/rejected` shows them"
    assert line == f"rejected 3 payloads; {shown}"


def test_sealing_is_mentioned_only_when_it_is_behind_or_fails() -> None:
    status = _line(*range(9))
    assert "unsealed" not in status.line(dataclasses.replace(NOTHING, unsealed=3), 0)
    behind = dataclasses.replace(NOTHING, unsealed=1_004)
    assert status.line(behind, 0).endswith(" GB free · 1,004 unsealed")
    assert status.warnings(behind) == []
    failing = dataclasses.replace(NOTHING, unsealed=1, sealing_error="no room; free space")
    assert status.line(failing, 0).endswith(" · sealing fails, 1 unsealed")
    assert status.warnings(failing) == ["sealing fails: no room; free space"]
    assert status.warnings(failing) == [], "once"
    assert status.warnings(NOTHING) == []
    assert status.warnings(failing) == ["sealing fails: no room; free space"], "it fails again"


def test_a_report_is_clean_if_this_recorder_lost_nothing() -> None:
    assert NOTHING.clean
    assert dataclasses.replace(NOTHING, missing=4, missing_before=4).clean
    for name in ("rejected", "queue_full", "transport_missed", "unwritten", "missing"):
        assert not dataclasses.replace(NOTHING, **{name: 1}).clean, name


def test_the_summary_uses_singular_and_plural() -> None:
    report = dataclasses.replace(NOTHING, recorded=1_234, missing=1, next_offset=1)
    assert summary(Path("L"), report) == (
        "L: 1,234 recorded, 0 rejected, 0 lost, 1 keyframe missing; 1 event in the log"
    )
