"""Which new Object is one that stood elsewhere: looks and odds of a few Objects given by hand."""

from dataclasses import dataclass, field
from typing import Any

import pytest

from eventsrc.envelope import Offset
from projections.deltas import (
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
from projections.reducers.presence import Presence
from projections.reducers.relocations import Moved, Relocations
from projections.settings import Camera


@dataclass
class Table:
    """Classes, numbers of observations, and looks as they are written in."""

    classes: dict[int, str] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)
    looks: dict[tuple[int, int], float | None] = field(default_factory=dict)
    asked: int = 0

    def class_of(self, ordinal: ObjectOrdinal) -> str:
        return self.classes[ordinal]

    def observations_of(self, ordinal: ObjectOrdinal) -> int:
        return self.counts[ordinal]

    def compare(self, one: ObjectOrdinal, other: ObjectOrdinal) -> float | None:
        self.asked += 1
        return self.looks.get((one, other), -5.0)


class Story:
    """Objects found and seen one after another, each from far away from all others."""

    def __init__(self) -> None:
        self.table, self.presence, self.offset = Table(), Presence(), 0
        self.relocations = Relocations(self.presence, self.table)

    def see(self, ordinal: int, run: int, times: int = 1, name: str = "chair") -> list[Moved]:
        """Pairs told while an Object was seen so often."""
        told: list[Moved] = []
        for _ in range(times):
            count = self.table.counts[ordinal] = self.table.counts.get(ordinal, 0) + 1
            thing, observation = ObjectOrdinal(ordinal), ObservationOrdinal(self.offset)
            deltas: list[Delta] = []
            if count == 1:
                self.table.classes[ordinal] = name
                deltas.append(ObjectFound(1, thing, "o", name, observation))
            deltas.append(ObjectSeen(1, thing, observation, 0, count, 0, 0, 0.0, 0.0))
            there = 10_000_000 * ordinal + 2_000_000, 0
            deltas.append(ObjectEstimated(1, thing, *there, 1, 0, 1, 1))
            told += self.fold(run, 10_000_000 * ordinal, deltas)
        return told

    def miss(self, ordinal: int, run: int, times: int = 1) -> list[Moved]:
        """Pairs told while an Object was looked for in vain."""
        return [p for _ in range(times) for p in self.fold(run, 10_000_000 * ordinal, [])]

    def fold(self, run: int, x_um: int, deltas: list[Delta]) -> list[Moved]:
        self.offset += 1
        pose = Pose(x_um, 0, 0.0)
        self.presence.fold(Offset(self.offset), RunOrdinal(run), pose, Camera(), deltas)
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


def test_the_best_candidate_is_the_newcomer_at_its_fourth_observation(story):
    story.table.looks |= {(0, 3): 2.5, (1, 3): 2.3, (2, 3): 9.0}
    assert story.see(3, 1, 3) == []
    assert story.see(3, 1) == [Moved(0, 3, 15, 2.5)]
    assert story.see(0, 1, 60) == []  # it is told once


@pytest.mark.parametrize(
    ("first", "second", "told"),
    [
        (2.25, 2.0, [0]),
        (2.24, 2.0, []),
        (2.3, 2.4, [1]),
        (None, 2.3, [1]),  # kept apart by a command
        (2.3, None, [0]),
    ],
)
def test_the_evidence_of_the_best_must_be_enough(story, first, second, told):
    story.table.looks |= {(0, 3): first, (1, 3): second}
    assert [pair.old for pair in story.see(3, 1, 4)] == told


@pytest.mark.parametrize(("look", "is_told"), [(1.4, False), (1.5, True)])
def test_misses_of_the_older_one_add_to_evidence_of_looks(story, look, is_told):
    story.table.looks |= {(0, 3): look}
    assert story.see(3, 1, 30) == []
    told = story.miss(0, 1, 16)
    assert told == ([Moved(0, 3, 15, look)] if is_told else [])


def test_what_was_surely_seen_in_the_run_is_no_candidate(story):
    story.table.looks |= {(0, 3): 6.0}
    story.see(0, 1)
    assert story.see(3, 1, 30) == []
    story.miss(0, 2, 8)  # run 2 no longer sees it, but the newcomer is of run 1
    assert story.see(3, 2, 60) == []


def test_what_one_run_found_is_two_things(story):
    story.table.looks |= {(0, 3): 6.0}
    assert story.see(3, 0, 30) == []


def test_an_older_one_with_one_observation_is_no_candidate():
    story = Story()
    story.see(0, 0)
    story.table.looks |= {(0, 1): 6.0}
    assert story.see(1, 1, 30) == []


def test_a_class_by_vote_counts(story):
    story.table.looks |= {(2, 3): 6.0}
    assert story.see(3, 1, 4) == []
    story.table.classes[3] = "table"
    story.fold(1, 30_000_000, [ObjectClassified(1, ObjectOrdinal(3), "table")])
    assert story.see(3, 1, 4) == [Moved(2, 3, 15, 6.0)]


def test_an_absorbed_object_is_no_candidate(story):
    story.table.looks |= {(1, 3): 6.0, (0, 3): -1.0}
    story.fold(0, 0, [ObjectsMerged(1, ObjectOrdinal(0), ObjectOrdinal(1), 10, 0, 0, 0.0, 0.0)])
    assert story.see(3, 1, 30) == []


def test_comparisons_are_bounded_however_many_there_are():
    story = Story()
    for ordinal in range(300):
        story.see(ordinal, 0, 2)
    story.table.asked = 0
    story.see(300, 1, 4)
    assert 100 < story.table.asked <= 128


def test_newcomers_are_compared_when_they_have_doubled(story):
    story.see(3, 1, 40)
    assert story.table.asked == 2 * 4  # at 4, 8, 16, 32 with either chair


def test_a_snapshot_goes_on_where_it_was_taken(story):
    story.table.looks |= {(0, 3): 2.5}
    story.see(3, 1, 3)
    again = Relocations(story.presence, story.table)
    state: dict[str, Any] = story.relocations.dump()
    again.load(state)
    assert again.dump() == state
    story.relocations = again
    assert story.see(3, 1) == [Moved(0, 3, 15, 2.5)]
