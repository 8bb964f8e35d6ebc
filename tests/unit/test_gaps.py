"""The gap ledger, case by case."""

import pytest

from eventsrc.envelope.gaps import Gap, GapLedger

SETTLE_NS = 10


def _ledger(*keyframe_ids: int, at_ns: int = 0) -> GapLedger:
    ledger = GapLedger(SETTLE_NS)
    for keyframe_id in keyframe_ids:
        ledger.record("run-a", keyframe_id, at_ns)
    return ledger


def test_a_run_in_order_lacks_nothing() -> None:
    ledger = _ledger(40, 41, 42)
    assert list(ledger.gaps()) == []
    assert (ledger.highest("run-a"), ledger.highest("run-b")) == (42, None)


def test_ids_between_recorded_ones_are_missing() -> None:
    ledger = _ledger(1, 5, 9)
    assert list(ledger.gaps()) == [Gap("run-a", 2, 4), Gap("run-a", 6, 8)]
    assert ledger.missing == 6


def test_a_gap_is_reported_once_and_only_when_it_has_settled() -> None:
    ledger = _ledger(1, 3, at_ns=100)
    assert ledger.due(109) == []
    assert ledger.due(110) == [Gap("run-a", 2, 2)]
    assert ledger.due(1_000) == []
    assert ledger.flush() == []
    assert list(ledger.gaps()) == [Gap("run-a", 2, 2)], "reported is not closed"


def test_a_keyframe_within_the_settle_time_is_no_gap() -> None:
    ledger = _ledger(1, 3, at_ns=100)
    ledger.record("run-a", 2, 105)
    assert ledger.due(1_000) == []
    assert ledger.missing == 0
    assert ledger.duplicates == 0


def test_a_late_keyframe_closes_a_reported_gap() -> None:
    ledger = _ledger(1, 3)
    ledger.flush()
    ledger.record("run-a", 2, 50)
    assert list(ledger.gaps()) == []
    assert ledger.flush() == []


def test_a_keyframe_in_the_middle_splits_a_hole_and_keeps_its_age() -> None:
    ledger = _ledger(1, 9, at_ns=100)
    ledger.record("run-a", 5, 109)
    assert ledger.due(110) == [Gap("run-a", 2, 4), Gap("run-a", 6, 8)]


def test_the_halves_of_a_reported_hole_are_not_reported_again() -> None:
    ledger = _ledger(1, 9)
    ledger.flush()
    ledger.record("run-a", 5, 50)
    assert ledger.due(1_000) == []
    assert ledger.missing == 6


def test_an_id_below_the_first_opens_a_hole_up_to_it() -> None:
    ledger = _ledger(10, 7)
    assert list(ledger.gaps()) == [Gap("run-a", 8, 9)]
    ledger.record("run-a", 6, 0)
    assert list(ledger.gaps()) == [Gap("run-a", 8, 9)]


def test_runs_are_counted_separately() -> None:
    ledger = _ledger(1, 2)
    ledger.record("run-b", 7, 0)
    ledger.record("run-b", 9, 0)
    assert list(ledger.gaps()) == [Gap("run-b", 8, 8)]


def test_a_keyframe_recorded_twice_is_a_duplicate() -> None:
    ledger = _ledger(1, 2, 3, 2, 3, 1)
    assert ledger.duplicates == 3
    assert ledger.missing == 0


def test_what_an_earlier_recorder_reported_is_not_reported_again() -> None:
    ledger = _ledger(1, 5, 7)
    ledger.mark_reported(Gap("run-a", 2, 4))
    ledger.mark_reported(Gap("run-unknown", 2, 4))
    assert ledger.flush() == [Gap("run-a", 6, 6)]


def test_announced_keyframes_are_missing_after_the_settle_time() -> None:
    ledger = _ledger(1, 2, at_ns=100)
    ledger.expect("run-a", 5, 101)
    ledger.record("run-a", 4, 105)
    assert ledger.due(110) == []
    assert ledger.missing == 1, "before, it may still be on its way"
    assert ledger.due(111) == [Gap("run-a", 5, 5)]
    assert ledger.due(115) == [Gap("run-a", 3, 3)]
    assert (ledger.missing, ledger.highest("run-a")) == (2, 5)
    ledger.record("run-a", 6, 200)
    ledger.record("run-a", 5, 200)
    assert list(ledger.gaps()) == [Gap("run-a", 3, 3)], "it may come late like any other"


def test_young_announcements_and_those_of_unknown_runs_are_no_gap() -> None:
    ledger = _ledger(1, at_ns=100)
    ledger.expect("run-b", 7, 100)
    assert ledger.due(110) == []
    ledger.expect("run-a", 7, 111)
    assert ledger.flush() == []
    assert ledger.due(1_000) == []
    assert (ledger.missing, ledger.highest("run-b")) == (0, None)


def test_each_announcement_adds_only_new_keyframes() -> None:
    ledger = _ledger(1)
    for last in (3, 2, 6):
        ledger.expect("run-a", last, 0)
    assert ledger.due(SETTLE_NS) == [Gap("run-a", 2, 3), Gap("run-a", 4, 6)]


def test_closed_gaps_and_forgotten_runs_are_not_missing() -> None:
    ledger = _ledger(1, 5, 7)
    ledger.close(Gap("run-a", 2, 4))
    ledger.close(Gap("run-b", 2, 4))
    assert ledger.missing == 1
    assert ledger.forget("run-a") == [Gap("run-a", 6, 6)]
    assert (ledger.missing, ledger.flush(), ledger.highest("run-a")) == (0, [], None)


def test_a_part_of_a_hole_can_have_been_reported() -> None:
    """A recorder that said 2 to 4 were missing, when 5 to 8 were not known yet."""
    ledger = _ledger(1, 9)
    ledger.mark_reported(Gap("run-a", 2, 4))
    assert ledger.missing_reported() == 3
    assert ledger.flush() == [Gap("run-a", 5, 8)]


def test_a_gap_holds_at_least_one_keyframe() -> None:
    with pytest.raises(ValueError, match="ends at 2 before 3"):
        Gap("run-a", 3, 2)


def test_a_jump_over_the_whole_range_is_cheap() -> None:
    ledger = _ledger(-(2**63), 2**63 - 1)
    assert ledger.missing == 2**64 - 2


def test_a_gap_can_be_added_from_a_loss_event() -> None:
    ledger = GapLedger(SETTLE_NS)
    ledger.add_reported(Gap("run-a", 2, 4), now_ns=0)
    ledger.add_reported(Gap("run-a", 8, 2**62), now_ns=0)
    assert ledger.missing_reported() == 3 + 2**62 - 7
    ledger.record("run-a", 3, 0)
    ledger.record("run-a", 9, 0)
    ledger.record("run-b", 9, 0)
    assert ledger.missing_reported() == 2 + 2**62 - 8


def test_adjacent_loss_events_extend_a_run() -> None:
    ledger = _ledger(1)
    for gap in (Gap("run-a", 2, 3), Gap("run-a", 4, 6)):
        ledger.add_reported(gap, now_ns=0)
    assert (ledger.missing, ledger.missing_reported(), ledger.flush()) == (5, 5, [])
