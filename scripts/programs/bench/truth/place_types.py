"""Types of places against the true rooms' names: the table of ``scripts/bench_truth --types``.

A place's true type is the one that the name of its keyframes' commonest room says; places in rooms
whose name says none ("balcony", "exam 2") are counted apart. Beside it the plain baseline: every
place is of the type that most rooms of the table are of.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from projections.fold.place_types import type_of_name
from projections.fold.settings import Settings
from projections.localize.evaluate.truth import Truth
from projections.map.view import MapView

from .folding import fold_timed
from .tables import number
from .worlds import Case


@dataclass(frozen=True, slots=True)
class TypedPlace:
    """``true`` is None in a room whose name says no type, ``said`` where the map is unsure or has
    nothing to tell by, ``likeliest`` only in the latter case; ``keyframes`` how many poses are in
    it."""

    true: str | None
    said: str | None
    likeliest: str | None
    probability: float
    keyframes: int


@dataclass(frozen=True, slots=True)
class TypesRow:
    """The places of one case under one rule of fusion."""

    name: str
    places: tuple[TypedPlace, ...]


def types_row(case: Case, settings: Settings) -> TypesRow:
    """Fold a case and read its places' types."""
    view, _ = fold_timed(case.events, settings)
    return TypesRow(f"{case.name} {settings.fusion}", typed_places(view, case.truth))


def typed_places(view: MapView, truth: Truth) -> tuple[TypedPlace, ...]:
    """The places of a view whose room is known."""
    found = []
    for place in view.places.values():
        members = [view.keyframes[k] for k in place.members]
        rooms = Counter(truth.room((k.run_id, k.keyframe_id)) for k in members)
        del rooms[None]
        if not rooms:
            continue
        room = min(rooms, key=lambda name: (-rooms[name], str(name)))
        kind = view.type_of(place.ordinal)
        true = type_of_name(str(room))
        if kind is None:
            found.append(TypedPlace(true, None, None, 0.0, len(members)))
        else:
            likeliest = kind.candidates[0][0] if kind.candidates else None
            found.append(TypedPlace(true, kind.type, likeliest, kind.probability, len(members)))
    return tuple(found)


def types_table(rows: Sequence[TypesRow]) -> str:
    """A line for each case, then all of each rule of fusion.

    Of the places in rooms whose name says a type: shares that are right, wrong and unsure; right of
    those not unsure; right if the likeliest type always counted; the baseline; and keyframes in
    places of the right type. Then how many other places there are, and how often these are unsure.
    """
    heads = [
        "places",
        "right",
        "wrong",
        "unsure",
        "sure&ok",
        "common",
        "kf right",
        "other",
        "unsure",
    ]
    lines = [_line("profile world fusion", heads)]
    lines += [_line(row.name, _cells(row.places)) for row in rows]
    for fusion in sorted({row.name.split()[-1] for row in rows}):
        of_fusion = [p for row in rows if row.name.endswith(fusion) for p in row.places]
        lines.append(_line(f"all {fusion}", _cells(of_fusion)))
        for low, high in ((0.5, 0.7), (0.7, 0.9), (0.9, 1.1)):
            sure = [p for p in of_fusion if p.true and p.said and low <= p.probability < high]
            right = sum(p.said == p.true for p in sure)
            lines.append(
                f"  said with {low} or more: {len(sure)}, right {_share(right, len(sure))}"
            )
    return "\n".join(lines)


def _cells(places: Sequence[TypedPlace]) -> list[str]:
    known = [p for p in places if p.true is not None]
    right = [p for p in known if p.said == p.true]
    unsure = [p for p in known if p.said is None]
    common = max(Counter(p.true for p in known).values(), default=0)
    others = [p for p in places if p.true is None]
    keyframes = sum(p.keyframes for p in known)
    return [
        str(len(known)),
        _share(len(right), len(known)),
        _share(len(known) - len(right) - len(unsure), len(known)),
        _share(len(unsure), len(known)),
        _share(len(right), len(known) - len(unsure)),
        _share(sum(p.likeliest == p.true for p in known), len(known)),
        _share(common, len(known)),
        _share(sum(p.keyframes for p in right), keyframes),
        str(len(others)),
        _share(sum(p.said is None for p in others), len(others)),
    ]


def _share(part: int, whole: int) -> str:
    return number(part / whole, 2) if whole else "-"


def _line(name: str, cells: Sequence[str]) -> str:
    return name.ljust(34) + " ".join(cell.rjust(9) for cell in cells)
