"""Gaps in the sequence numbers of Zenoh's advanced publishers."""

import random

import pytest

from eventsrc.envelope.gaps import Gap
from eventsrc.record.recorder.queue import MAX_SOURCES, SequenceGaps
from eventsrc.record.transport.session import SequenceNumber

SETTLE_NS = 10


def _gaps(*values: int, source: str = "a:1") -> SequenceGaps:
    gaps = SequenceGaps(SETTLE_NS)
    for value in values:
        gaps.record(SequenceNumber(source, value), 0)
    return gaps


def test_a_gap_is_returned_once_when_it_has_settled() -> None:
    gaps = _gaps(0, 1, 4, 9, 8)
    assert gaps.due(SETTLE_NS - 1) == []
    assert gaps.due(SETTLE_NS) == [Gap("a:1", 2, 3), Gap("a:1", 5, 7)]
    gaps.record(SequenceNumber("a:1", 2), SETTLE_NS)
    assert gaps.flush() == []


@pytest.mark.parametrize("seed", range(3))
def test_reordered_and_repeated_numbers_leave_no_gap(seed: int) -> None:
    values = [*range(50), *range(10)]
    random.Random(seed).shuffle(values)
    assert _gaps(*values).flush() == []


def test_a_heartbeat_reveals_that_the_last_messages_are_missing() -> None:
    gaps = _gaps(5, 6)
    gaps.expect(SequenceNumber("a:1", 8), 0)
    assert gaps.due(SETTLE_NS) == [Gap("a:1", 7, 8)]


def test_an_unknown_publisher_has_no_gap_before_its_first_number() -> None:
    gaps = SequenceGaps(SETTLE_NS)
    gaps.expect(SequenceNumber("a:1", 8), 0)
    gaps.record(SequenceNumber("b:1", 7), 0)
    gaps.record(SequenceNumber("a:1", 10), 0)
    assert gaps.flush() == [Gap("a:1", 9, 9)]


def test_numbers_wrap_around_after_32_bits() -> None:
    gaps = _gaps(2**32 - 2, 2**32 - 1, 0, 3)
    assert gaps.flush() == [Gap("a:1", 2**32 + 1, 2**32 + 2)]


def test_forged_publishers_cannot_fill_the_memory_or_hide_a_gap() -> None:
    gaps = _gaps(0, 2)
    for number in range(3 * MAX_SOURCES):
        gaps.record(SequenceNumber(f"forged:{number}", 1), 0)
    assert len(gaps._sources) == MAX_SOURCES
    assert len(gaps._ledger.state()) == MAX_SOURCES
    assert gaps.due(0) == [Gap("a:1", 1, 1)]
