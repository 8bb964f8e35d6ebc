"""Repeated lines are held back and counted."""

from projections.surfaces.serve.answering import REPEAT_S, RepeatFilter


def test_a_line_passes_at_once_and_then_once_a_minute_with_a_count() -> None:
    now, passed = [0.0], list[str]()
    lines = RepeatFilter(passed.append, now=lambda: now[0])
    for _ in range(3):
        lines("away")
    lines("other")
    assert passed == ["away", "other"]
    now[0] = REPEAT_S
    lines("away")
    lines("away")
    assert passed[2:] == ["away (and 2 more like it since)"]


def test_the_number_of_remembered_lines_is_bounded() -> None:
    passed = list[str]()
    lines = RepeatFilter(passed.append, now=lambda: 0.0)
    for number in range(1_000):
        lines(f"line {number}")
    assert len(passed) == 1_000
    assert len(lines._passed) <= 100
