"""The numbers of Zenoh's advanced publishers: what never came, whatever order the rest came in."""

import random

import pytest

from eventsrc.gaps import Gap
from eventsrc.recorder.queue import MOST_SOURCES, Numbering
from eventsrc.transport.session import SequenceNumber

SETTLE_NS = 10


def _numbering(*values: int, source: str = "a:1") -> Numbering:
    numbering = Numbering(SETTLE_NS)
    for value in values:
        numbering.arrived(SequenceNumber(source, value), 0)
    return numbering


def test_a_gap_is_told_once_when_it_has_settled() -> None:
    numbering = _numbering(0, 1, 4, 9, 8)
    assert numbering.due(SETTLE_NS - 1) == []
    assert numbering.due(SETTLE_NS) == [Gap("a:1", 2, 3), Gap("a:1", 5, 7)]
    numbering.arrived(SequenceNumber("a:1", 2), SETTLE_NS)
    assert numbering.flush() == []


@pytest.mark.parametrize("seed", range(3))
def test_order_and_repetition_are_no_loss(seed: int) -> None:
    values = [*range(50), *range(10)]
    random.Random(seed).shuffle(values)
    assert _numbering(*values).flush() == []


def test_the_last_are_missed_when_their_publisher_tells_of_them() -> None:
    numbering = _numbering(5, 6)
    numbering.told(SequenceNumber("a:1", 8), 0)
    assert numbering.due(SETTLE_NS) == [Gap("a:1", 7, 8)]


def test_of_an_unknown_publisher_only_what_follows_is_missed() -> None:
    numbering = Numbering(SETTLE_NS)
    numbering.told(SequenceNumber("a:1", 8), 0)
    numbering.arrived(SequenceNumber("b:1", 7), 0)
    numbering.arrived(SequenceNumber("a:1", 10), 0)
    assert numbering.flush() == [Gap("a:1", 9, 9)]


def test_numbers_go_on_after_the_last() -> None:
    numbering = _numbering(2**32 - 2, 2**32 - 1, 0, 3)
    assert numbering.flush() == [Gap("a:1", 2**32 + 1, 2**32 + 2)]


def test_forged_publishers_do_not_fill_the_memory_and_hide_no_loss() -> None:
    numbering = _numbering(0, 2)
    for number in range(3 * MOST_SOURCES):
        numbering.arrived(SequenceNumber(f"forged:{number}", 1), 0)
    assert len(numbering._sources) == MOST_SOURCES
    assert len(numbering._ledger.state()) == MOST_SOURCES
    assert numbering.due(0) == [Gap("a:1", 1, 1)]
