"""Scores of `mapfold find` and `mapfold changes` on a building in which things were moved: the
table of ``scripts/bench_truth --ask``."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from projections.ask.find import Wanted, find
from projections.ask.what_changed import KINDS, map_changes
from projections.localize.evaluate.truth import Truth
from projections.map.view import MapView

from .scoring import majorities
from .worlds import TrueThing


@dataclass(frozen=True, slots=True)
class AskedRow:
    """``first`` of the ``classes`` found have a true thing of the class as their first answer, as
    far from the truth as ``errors_m``. ``told`` and ``true`` are the changes of each kind: a thing
    of a true change stands elsewhere than in run a."""

    name: str
    classes: int
    first: int
    errors_m: tuple[float, ...]
    told: tuple[int, ...]
    true: tuple[int, ...]


def asked_row(
    name: str,
    before: MapView,
    after: MapView,
    truth: Truth,
    things: Mapping[str, TrueThing],
    same_class: Mapping[str, str],
) -> AskedRow:
    """Ask the map of both runs for each class that it has, and what changed since the first.
    ``same_class`` gives for a detector's word the class that the truth has."""
    owners = majorities(after, truth)
    owner_of = {each.object_id: owners.get(number) for number, each in after.objects.items()}
    classes = sorted({each.class_name for each in after.objects.values() if each.confirmed})
    first, errors = 0, list[float]()
    for class_name in classes:
        found = find(after, Wanted(what=class_name, top=1)).answers[0]
        thing = things.get(owner_of[found.object_id] or "")
        if thing is None or same_class.get(class_name, class_name) != thing.class_name:
            continue
        first += 1
        spots = [thing.moved_to or (thing.x, thing.y)]
        errors.append(min(math.dist((found.x, found.y), spot) for spot in spots))
    moved = {thing.instance for thing in things.values() if thing.moved_to is not None}
    told, true = dict.fromkeys(KINDS, 0), dict.fromkeys(KINDS, 0)
    was = majorities(before, truth)
    was_of = {each.object_id: was.get(number) for number, each in before.objects.items()}
    for change in map_changes(before, after).changes:
        told[change.kind] += 1
        of = owner_of if change.kind == "new" else was_of
        true[change.kind] += of[change.object_id] in moved
    return AskedRow(
        name, len(classes), first, tuple(errors), tuple(told.values()), tuple(true.values())
    )


def asked_table(rows: Sequence[AskedRow]) -> str:
    """A line for each case, the one with the least share of classes found last; then all."""
    heads = ["classes", "first", "share", "p50 m", *(f"{kind}" for kind in KINDS), "precise"]
    lines = [_line("find and changes", heads)]
    ordered = sorted(rows, key=lambda row: -_share(row.first, row.classes))
    lines += [_line(row.name, _cells(row)) for row in ordered]
    whole = AskedRow(
        "all",
        sum(row.classes for row in rows),
        sum(row.first for row in rows),
        tuple(error for row in rows for error in row.errors_m),
        tuple(map(sum, zip(*(row.told for row in rows), strict=True))),
        tuple(map(sum, zip(*(row.true for row in rows), strict=True))),
    )
    return "\n".join([*lines, _line("all", _cells(whole))])


def _cells(row: AskedRow) -> list[str]:
    errors = sorted(row.errors_m)
    return [
        str(row.classes),
        str(row.first),
        f"{_share(row.first, row.classes):.3f}",
        f"{errors[len(errors) // 2]:.2f}" if errors else "-",
        *(f"{true}/{told}" for true, told in zip(row.true, row.told, strict=True)),
        f"{_share(sum(row.true), sum(row.told)):.3f}" if sum(row.told) else "-",
    ]


def _share(part: int, whole: int) -> float:
    return part / whole if whole else math.nan


def _line(name: str, cells: Sequence[str]) -> str:
    return name.ljust(26) + " ".join(cell.rjust(7) for cell in cells)
