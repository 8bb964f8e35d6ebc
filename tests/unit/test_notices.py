"""Lines about what happens often are held back, and counted."""

from projections.serve.answering import EVERY_S, Notices


def test_a_line_is_told_at_once_and_then_once_a_minute_with_a_count() -> None:
    now, told = [0.0], list[str]()
    notices = Notices(told.append, now=lambda: now[0])
    for _ in range(3):
        notices("away")
    notices("other")
    assert told == ["away", "other"]
    now[0] = EVERY_S
    notices("away")
    notices("away")
    assert told[2:] == ["away (and 2 more like it since)"]


def test_the_lines_that_it_remembers_are_bounded() -> None:
    told = list[str]()
    notices = Notices(told.append, now=lambda: 0.0)
    for number in range(1_000):
        notices(f"line {number}")
    assert len(told) == 1_000
    assert len(notices._told) <= 100
