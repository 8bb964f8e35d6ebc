"""What a difference says of Objects that moved, are missing or jitter, from rows by hand."""

import math
from collections.abc import Mapping

import pytest

from eventsrc.envelope.model import Offset
from projections.ask.object_changes import (
    ObjectChanges,
    ObjectRow,
    changes_document,
    object_changes,
    object_shift_m,
)
from projections.fold.deltas import ObservationOrdinal
from projections.map.records import EstimatedPosition, Relocation


def row(
    name: str = "a",
    at: tuple[float, float] | None = (0.0, 0.0),
    sigma: float = 0.1,
    relocations: int = 0,
    **more: object,
) -> ObjectRow:
    """A chair that stands at ``at``; the robot saw it from (5, 5)."""
    estimate = None
    if at is not None:
        variance = round(sigma * sigma * 1e12)
        x_um, y_um = (round(value * 1e6) for value in at)
        estimate = EstimatedPosition(x_um, y_um, variance, 0, variance, 4)
    moves = [Relocation(Offset(n), ObservationOrdinal(n), 0, 0, 1, 1) for n in range(relocations)]
    values = {"class_name": "chair", "mean_x": 5.0, "mean_y": 5.0, "place_id": "p0", **more}
    return ObjectRow(
        object_id=name,
        first_seen=0.0,
        last_seen=1.0,
        det_ids=("d0",),
        estimate=estimate,
        relocations=tuple(moves),
        **values,  # type: ignore[arg-type]
    )


def compared(
    before: list[ObjectRow],
    after: list[ObjectRow],
    joined: Mapping[str, str] | None = None,
    *,
    is_forward: bool = True,
) -> ObjectChanges:
    first, second = ({r.object_id: r for r in rows} for rows in (before, after))
    pairs = [(first[k], second[k]) for k in first if k in second and first[k] != second[k]]
    return object_changes(first, second, pairs, joined or {}, is_forward=is_forward)


def test_what_the_fold_relocated_beyond_both_errors_has_moved() -> None:
    found = compared([row()], [row(at=(3.0, 4.0), sigma=0.2, relocations=1)])
    (move,) = found.moved
    assert move.distance_m == pytest.approx(5.0)
    assert move.error_m == pytest.approx(math.hypot(0.1, 0.2))
    assert move.sure
    document = changes_document(found)
    assert document["moved"] == [
        {
            "object_id": "a",
            "class_name": "chair",
            "from": [0.0, 0.0],
            "to": [3.0, 4.0],
            "moved_m": pytest.approx(5.0),
            "error_m": pytest.approx(0.2236, abs=1e-4),
            "sure": True,
        }
    ]
    assert (document["shifted_within_error"], document["shifted_beyond_error"]) == (0, 0)


def test_a_thing_that_came_back_to_its_place_has_not_moved_in_between() -> None:
    found = compared([row()], [row(at=(0.1, 0.0), relocations=2)])
    assert (found.moved, found.jitter) == ((), 1)


@pytest.mark.parametrize(
    ("shift", "sigma", "within"), [(0.2, 0.1, True), (0.42, 0.1, True), (0.44, 0.1, False)]
)
def test_a_shift_without_a_relocation_is_no_move(shift: float, sigma: float, within: bool) -> None:
    """9.21 of a squared distance over a sum of variances of 0.02 m² is 0.429 m."""
    found = compared([row(sigma=sigma)], [row(at=(shift, 0.0), sigma=sigma)])
    assert found.moved == ()
    assert (found.jitter, found.corrected) == ((1, 0) if within else (0, 1))


def test_the_farthest_move_comes_first() -> None:
    before = [row(name, at=(float(n), 9.0)) for n, name in enumerate("abc")]
    spots = {"a": 2.0, "b": 9.0, "c": 5.0}
    after = [row(name, at=(x, 9.0), relocations=1) for name, x in spots.items()]
    moved = compared(before, after).moved
    assert [move.after.object_id for move in moved] == ["b", "c", "a"]


MOVED = row(at=(4.0, 0.0), relocations=1)


@pytest.mark.parametrize(
    ("before", "after", "other", "sure"),
    [
        (row(), MOVED, row("b", at=(0.2, 0.0)), False),  # an alike one stands where it stood
        (row(), MOVED, row("b", at=(1.0, 0.0)), True),
        (row(), MOVED, row("b", at=(0.2, 0.0), class_name="cup"), True),
        (row(sigma=0.6), MOVED, row("b", at=(4.0, 4.0)), False),  # its position was uncertain
        (row(), row(at=(4.0, 0.0), sigma=0.6, relocations=1), row("b", at=(4.0, 4.0)), False),
        (row(), row(missing=True), row("b", at=(0.2, 0.0)), False),
        (row(), row(missing=True), row("b", at=(1.0, 0.0)), True),
        (row(sigma=0.6), row(sigma=0.6, missing=True), row("b", at=(4.0, 4.0)), False),
    ],
)
def test_a_change_is_sure_unless_badly_known_or_replaced_by_one_of_its_class(
    before: ObjectRow, after: ObjectRow, other: ObjectRow, sure: bool
) -> None:
    found = compared([before, other], [after, other])
    assert [each.sure for each in (*found.moved, *found.missing)] == [sure]
    back = compared([after, other], [before, other], is_forward=False)
    assert [each.sure for each in (*back.moved, *back.missing)] == [sure]
    assert [move.distance_m for move in back.moved] == [move.distance_m for move in found.moved]


def test_missing_and_back() -> None:
    gone = compared([row()], [row(missing=True)])
    assert changes_document(gone)["missing"] == [
        {"object_id": "a", "class_name": "chair", "at": [0.0, 0.0], "sure": True}
    ]
    again = changes_document(compared([row(missing=True)], [row()]))
    assert (again["missing"], [each["object_id"] for each in again["back"]]) == ([], ["a"])


def test_without_estimates_nothing_is_called_moved() -> None:
    before, after = row(at=None), row(at=None, mean_x=8.0)
    found = compared([before], [after])
    assert (found.moved, found.jitter, found.corrected) == ((), 1, 0)
    assert object_shift_m(before, after) == 3.0


def test_the_shift_is_that_of_the_estimates_where_both_have_one() -> None:
    assert object_shift_m(row(), row(at=(3.0, 4.0), mean_x=8.0)) == 5.0
    assert object_shift_m(row(), row(at=None, mean_x=8.0)) == 3.0
