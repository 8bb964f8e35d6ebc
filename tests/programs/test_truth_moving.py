"""The scores of moved things on cases small enough to score by hand."""

import pytest

from projections.fold.deltas import ObjectMissing, ObjectOrdinal, ObjectRelocated, RunOrdinal
from scripts.programs.bench.truth.moving import MovedScores, score_moved
from scripts.programs.bench.truth.scoring import ObjectScores
from scripts.programs.bench.truth.tables import Row, moved_table
from scripts.programs.bench.truth.telling import ToldScores, score_told, told_table
from scripts.programs.bench.truth.worlds import TrueThing
from tests.programs.truth_cases import hand_made

THINGS = {
    name: TrueThing(name, 0.0, 0.0, (1.0, 1.0) if name.startswith("m") else None)
    for name in ("m1", "m2", "m3", "m4", "m5", "s1", "s2", "s3")
}
SIGHTS = [
    ("a", 0, 0, "m1", 0),  # its new Object merges into the relocated one
    ("a", 0, 0, "m2", 1),  # missing
    ("a", 0, 0, "m3", 2),  # stays where it was, in the map
    ("a", 0, 0, "m4", 3),  # neither seen nor in view later: not knowable
    ("a", 0, 0, "s1", 4),
    ("a", 0, 0, "s2", 5),  # wrongly missing
    ("a", 0, 0, None, 6),  # a phantom, rightly missing
    ("a", 0, 0, None, 7),
    ("b", 0, 0, "m1", 0),
    ("b", 0, 0, "m3", 8),
    ("b", 0, 0, "m5", 9),  # not seen in run a
    ("b", 0, 0, "s1", 4),
    ("b", 0, 0, "s3", 10),  # not seen in run a
]
RELOCATED = ObjectRelocated(20, ObjectOrdinal(0), 8, 0, 0, 1, 1)


def missing(thing: int, *, is_missing: bool = True) -> ObjectMissing:
    return ObjectMissing(20, ObjectOrdinal(thing), RunOrdinal(1), 9, is_missing)


def score(sights=SIGHTS, more=(), looks=None, **least) -> MovedScores:
    return score_moved(*hand_made(sights, more), THINGS, "a", looks or {"m2": 3}, **least)


def test_each_thing_is_counted_once_for_what_the_map_says_of_it():
    more = [RELOCATED, missing(1), missing(5), missing(6), missing(4, is_missing=False)]
    scores = score(more=more)
    assert scores == MovedScores(
        knowable=3, moved=1, missing=1, others=2, wronged=1, phantoms=2, gone=1
    )


def test_a_map_without_reports_has_no_score_of_moved_things():
    scores = score()
    assert (scores.moved, scores.missing, scores.wronged, scores.gone) == (0, 0, 0, 0)
    assert (scores.knowable, scores.others) == (3, 2)


def test_an_object_of_the_later_run_alone_tells_nothing_of_the_first():
    # Object 8 is of m3, but was founded in run b: its relocation is none of m3's old Object.
    more = [ObjectRelocated(20, ObjectOrdinal(8), 9, 0, 0, 1, 1), missing(10)]
    scores = score(more=more)
    assert (scores.moved, scores.missing, scores.wronged) == (0, 0, 0)


def test_a_thing_with_two_old_objects_is_told_of_by_either():
    sights = [("a", 0, 0, "m1", 0), ("a", 0, 0, "m1", 1), ("b", 0, 0, "m1", 0)]
    assert score(sights, [missing(1)]).missing == 1
    both = score(sights, [RELOCATED, missing(1)])
    assert (both.moved, both.missing) == (1, 0)


@pytest.mark.parametrize(("looks", "counted"), [(0, 0), (2, 0), (3, 1)])
def test_things_seen_well_need_two_observations_and_three_looks(looks, counted):
    sights = [("a", 0, 0, "m1", 0), ("a", 0, 0, "m1", 0), ("a", 0, 0, "m2", 1)]
    scores = score(sights, looks={"m1": looks, "m2": 9}, least_seen=2, least_looks=3)
    assert scores.knowable == counted


def test_the_table_adds_the_lines_up_with_the_smallest_share_last():
    nothing = ObjectScores(0, 0, 1.0, 1.0, (), 0)

    def row(name: str, told: int) -> Row:
        moved = MovedScores(10, told, 1, 50, 1, 8, 4)
        return Row(name, 9, nothing, nothing, 0.0, 0.0, moved, MovedScores(5, told, 0, 40, 0, 8, 4))

    lines = moved_table([row("r one", 1), row("r two", 4)]).splitlines()
    assert [line.split()[1] for line in lines[1:3]] == ["two", "one"]
    assert " ".join(lines[1].split()[2:]) == "4 1 10 0.50 1 50 0.020 5 0.80 4/8"
    assert " ".join(lines[3].split()) == "all 5 2 20 0.35 2 100 0.020 10 0.50 8/16"


def test_a_difference_is_scored_by_what_its_objects_were_before():
    before, truth = hand_made([sight for sight in SIGHTS if sight[0] == "a"])
    after, _ = hand_made(SIGHTS, [missing(1), missing(5)])
    scores = score_told(before, after, truth, THINGS)
    # Without estimates nothing is sure; m1 to m4 were moved and are in the first map.
    assert scores == ToldScores(
        sure=0, sure_true=0, told=2, told_true=1, shifted=0, shifted_true=0, knowable=4
    )
    other = ToldScores(4, 3, 4, 3, 9, 1, 5)
    *_, last = told_table([("tripod w", scores), ("rover w", other)]).split("\n")
    assert last.split() == ["all", "3", "4", "0.75", "4", "6", "0.67", "9", "1", "9", "0.11"]
