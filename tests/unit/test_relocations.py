"""Which new Object is one that stood elsewhere: looks and odds of a few Objects given by hand."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import pytest

from eventsrc.envelope.model import Offset
from projections.fold.deltas import (
    Delta,
    ObjectClassified,
    ObjectEstimated,
    ObjectFound,
    ObjectOrdinal,
    ObjectSeen,
    ObjectsMerged,
    ObservationOrdinal,
    Pose,
    RunOrdinal,
)
from projections.fold.evidence_fusion import MovedObject, Relocations
from projections.fold.presence import Presence
from projections.fold.settings import CameraConstants


@dataclass
class Table:
    """Classes, numbers of observations, and looks as they are written in."""

    classes: dict[int, str] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)
    looks: dict[tuple[int, int], float | None] = field(default_factory=dict)
    """By pairs, the older one first."""
    asked: int = 0

    def class_of(self, ordinal: ObjectOrdinal) -> str:
        return self.classes[ordinal]

    def observations_of(self, ordinal: ObjectOrdinal) -> int:
        return self.counts[ordinal]

    def compare(self, one: ObjectOrdinal, others: Sequence[ObjectOrdinal]) -> list[float | None]:
        self.asked += len(others)
        return [self.looks.get((min(one, o), max(one, o)), -5.0) for o in others]


class Story:
    """Objects found and seen one after another, each from far away from all others."""

    def __init__(self) -> None:
        self.table, self.presence, self.offset = Table(), Presence(), 0
        self.relocations = Relocations(self.presence, self.table)

    def see(
        self, ordinal: int, run: int, times: int = 1, name: str = "chair", variance_m2: int = 0
    ) -> list[MovedObject]:
        """Pairs told while an Object was seen so often."""
        told: list[MovedObject] = []
        for _ in range(times):
            count = self.table.counts[ordinal] = self.table.counts.get(ordinal, 0) + 1
            thing, observation = ObjectOrdinal(ordinal), ObservationOrdinal(self.offset)
            deltas: list[Delta] = []
            if count == 1:
                self.table.classes[ordinal] = name
                deltas.append(ObjectFound(1, thing, "o", name, observation))
            deltas.append(ObjectSeen(1, thing, observation, 0, count, 0, 0, 0.0, 0.0))
            there = 10_000_000 * ordinal + 2_000_000, 0
            variances = variance_m2 * 10**12 + 1, 0, 1
            deltas.append(ObjectEstimated(1, thing, *there, *variances, 1))
            told += self.fold(run, 10_000_000 * ordinal, deltas)
        return told

    def miss(self, ordinal: int, run: int, times: int = 1) -> list[MovedObject]:
        """Pairs reported while no Object was found."""
        return [p for _ in range(times) for p in self.fold(run, 10_000_000 * ordinal, [])]

    def fold(self, run: int, x_um: int, deltas: list[Delta]) -> list[MovedObject]:
        self.offset += 1
        pose = Pose(x_um, 0, 0.0)
        self.presence.fold(Offset(self.offset), RunOrdinal(run), pose, CameraConstants(), deltas)
        told = self.relocations.fold(deltas)
        for pair in told:
            self.presence.relocate(pair.old, pair.new)
        return told


@pytest.fixture
def story() -> Story:
    """Two chairs and a table of run 0."""
    made = Story()
    for ordinal, name in enumerate(("chair", "chair", "table")):
        assert made.see(ordinal, 0, 5, name) == []
    return made


def test_the_best_candidate_is_the_newcomer_at_its_third_observation(story):
    story.table.looks |= {(0, 3): 4.5, (1, 3): 2.3, (2, 3): 9.0}
    assert story.see(3, 1, 2) == []
    assert story.see(3, 1) == [MovedObject(0, 3, 15, 4.5)]
    assert story.see(0, 1, 60) == []  # it is told once


@pytest.mark.parametrize(
    ("first", "second", "told"),
    [
        (2.0, -0.1, [0]),
        (2.0, 0.0, [0]),
        (2.0, 0.1, []),  # what looks like two tells little
        (1.9, -3.0, []),
        (6.0, 4.1, []),
        (3.0, 5.1, [1]),
        (None, 2.3, [1]),  # kept apart by a command
        (2.3, None, [0]),
    ],
)
def test_the_evidence_of_the_best_must_be_enough(story, first, second, told):
    story.table.looks |= {(0, 3): first, (1, 3): second}
    assert [pair.old for pair in story.see(3, 1, 3)] == told


def test_what_was_surely_seen_in_the_run_is_no_candidate(story):
    story.table.looks |= {(0, 3): 30.0}
    story.see(0, 1, 2)
    assert story.see(3, 1, 30) == []


def test_an_older_one_that_looks_like_another_seen_now_tells_little(story):
    """Chair 1 is seen in run 1, so it is not the newcomer; chair 0 looks like both."""
    story.table.looks |= {(0, 3): 4.0, (0, 1): 3.5, (1, 3): 0.0}
    story.see(1, 1)
    assert story.see(3, 1, 3) == []
    story.table.looks |= {(0, 1): 2.0}
    assert [pair.old for pair in story.see(3, 1, 3)] == [0]


def test_a_rival_of_the_older_one_that_was_not_seen_since_is_no_evidence(story):
    """That an earlier run saw two chairs alike does not tell which of them was carried here."""
    story.table.looks |= {(0, 3): 4.0, (0, 1): 3.5, (1, 3): 0.0}
    assert [pair.old for pair in story.see(3, 1, 3)] == [0]


def test_a_third_object_with_one_observation_does_not_count():
    for times, told in ((1, [0]), (2, [])):
        story = Story()
        story.see(0, 0, 5)
        story.see(1, 0, times)
        story.table.looks |= {(0, 2): 3.0, (1, 2): 2.5}
        assert [pair.old for pair in story.see(2, 1, 3)] == told


@pytest.mark.parametrize(("look", "is_told"), [(1.9, False), (2.0, True)])
def test_misses_of_the_older_one_add_to_evidence_of_looks(story, look, is_told):
    story.table.looks |= {(0, 3): look, (1, 3): 1.5}
    assert story.see(3, 1, 30) == []
    told = story.miss(0, 1, 16)
    assert told == ([MovedObject(0, 3, 15, look)] if is_told else [])


def test_what_was_seen_in_the_run_needs_more_evidence(story):
    """A sighting is eight times likelier where the thing still stands: log 8 is 2.08."""
    story.table.looks |= {(0, 3): 4.0}
    story.see(0, 1)
    assert story.see(3, 1, 30) == []
    story.miss(0, 2, 8)  # run 2 no longer sees it, but the newcomer is of run 1
    assert story.see(3, 2, 60) == []
    for look, told in ((4.0, []), (4.1, [0])):
        again = Story()
        again.see(0, 0, 5)
        again.see(0, 1)
        again.table.looks |= {(0, 1): look}
        assert [pair.old for pair in again.see(1, 1, 3)] == told


@pytest.mark.parametrize(("variance_m2", "told"), [(6, [0]), (7, [])])
def test_an_unsure_position_is_no_other_position(variance_m2, told):
    """Ten metres apart are four standard errors of 2.5 m: 100 m² = 16 · 6.25 m²."""
    story = Story()
    story.see(0, 0, 5)
    story.table.looks |= {(0, 1): 6.0}
    assert [pair.old for pair in story.see(1, 1, 3, variance_m2=variance_m2)] == told


def test_what_one_run_found_is_two_things(story):
    story.table.looks |= {(0, 3): 6.0}
    assert story.see(3, 0, 30) == []


def test_a_class_by_vote_counts(story):
    story.table.looks |= {(2, 3): 6.0}
    assert story.see(3, 1, 4) == []
    story.table.classes[3] = "table"
    story.fold(1, 30_000_000, [ObjectClassified(1, ObjectOrdinal(3), "table")])
    assert story.see(3, 1, 2) == [MovedObject(2, 3, 15, 6.0)]


def test_an_absorbed_object_is_no_candidate(story):
    story.table.looks |= {(1, 3): 6.0, (0, 3): -1.0}
    story.fold(0, 0, [ObjectsMerged(1, ObjectOrdinal(0), ObjectOrdinal(1), 10, 0, 0, 0.0, 0.0)])
    assert story.see(3, 1, 30) == []


def test_comparisons_are_bounded_however_many_there_are():
    story = Story()
    for ordinal in range(300):
        story.see(ordinal, 0, 2)
    story.table.asked = 0
    story.see(300, 1, 3)
    assert 100 < story.table.asked <= 128
    story.table.asked = 0
    story.table.looks |= {(299, 300): 9.0, (298, 300): 9.0}
    assert story.see(300, 1, 3) == []
    assert 100 < story.table.asked <= 2 * 128
    story.table.asked = 0
    story.miss(298, 1, 4)  # its misses double three times
    assert 3 <= story.table.asked <= 3 * 3 * 128


def test_newcomers_are_compared_when_they_have_doubled(story):
    story.see(3, 1, 40)
    assert story.table.asked == 2 * 4  # at 3, 6, 12, 24 with either chair


def test_a_kept_state_goes_on_where_it_was_kept(story):
    story.table.looks |= {(0, 3): 2.5}
    story.see(3, 1, 2)
    again = Relocations(story.presence, story.table)
    state: dict[str, Any] = story.relocations.dump()
    again.load(state)
    assert again.dump() == state
    story.relocations = again
    assert story.see(3, 1) == [MovedObject(0, 3, 15, 2.5)]
