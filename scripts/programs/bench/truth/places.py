"""Places against true rooms: the table of ``scripts/bench_truth --places``.

V counts every keyframe with a pose whose room is known; noise is one more cluster, so a rule that
leaves hard keyframes out gains nothing by it.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from eventsrc.envelope.occupancy_map import OccupancyMap
from projections.fold.deltas import KeyframeOrdinal, KeyframePlaced, PlaceOrdinal
from projections.fold.settings import Settings
from projections.localize.evaluate.scores import agreement
from projections.localize.evaluate.truth import Truth
from projections.map.view import MapView

from .folding import fold_into, fold_timed
from .tables import HOUSE, mean_of, number
from .walls import Walls
from .worlds import Case

RULES = {
    "1.5/3": Settings(),
    "0.75/8": Settings(eps_m=0.75, min_samples=8),
    "rooms": Settings(places="rooms"),
}
"""The rules of the table by their names; shares and ratios are told of the last."""
_OWN = ("homogeneity", "completeness", "noise", "late", "renamed", "ratio")
LEAST_WALLED = 0.5
"""Rooms have walls where so much of the borders between them are walls; else they are zones."""


@dataclass(frozen=True, slots=True)
class PlaceScores:
    """Places of one rule in one case.

    ``noise`` is the share of keyframes with a pose that are in no place at the end, ``late`` of
    those that were in none on arrival and got one later, ``renamed`` of those whose place at the
    end is not the first that they were in. ``ratio`` is places for each room driven through,
    ``seconds`` the processor time of the fold.
    """

    v_measure: float
    homogeneity: float
    completeness: float
    noise: float
    late: float
    renamed: float
    ratio: float
    seconds: float


@dataclass(frozen=True, slots=True)
class PlacesRow:
    """One case under each rule."""

    name: str
    keyframes: int
    rooms: int
    rules: dict[str, PlaceScores]
    walled: float | None = None
    """What share of the borders of the rooms are walls; None where no walls were asked for."""


def places_row(
    case: Case, rules: Mapping[str, Settings] = RULES, walls: Walls | None = None
) -> PlacesRow:
    """Fold a case under each rule and score its places; with ``walls``, the last once more with
    the building's occupancy map before the drive, as rule ``walls``."""
    rooms = {case.truth.room((a.envelope.run_id, a.envelope.keyframe_id)) for a in case.events}
    scores = {name: _score(case, settings) for name, settings in rules.items()}
    if walls is not None:
        scores["walls"] = _score(case, list(rules.values())[-1], walls.map)
    walled = None if walls is None else walls.walled
    return PlacesRow(case.name, len(case.events), len(rooms - {None}), scores, walled)


def _score(case: Case, settings: Settings, walls: OccupancyMap | None = None) -> PlaceScores:
    _, seconds = fold_timed(case.events, settings, walls)
    view, first, late = MapView(settings, keep_embeddings=False), {}, set()
    for _, deltas in fold_into(view, case.events, walls):
        for delta in deltas:
            if isinstance(delta, KeyframePlaced):
                first[delta.keyframe] = delta.place
                if delta.keyframe != len(view.keyframes) - 1:
                    late.add(delta.keyframe)
    return score_places(view, case.truth, first, len(late), seconds)


def score_places(
    view: MapView,
    truth: Truth,
    first: Mapping[KeyframeOrdinal, PlaceOrdinal],
    late: int,
    seconds: float,
) -> PlaceScores:
    """The scores of a view, given the first place of each keyframe that ever had one."""
    posed = {KeyframeOrdinal(i): k for i, k in enumerate(view.keyframes) if k.pose is not None}
    known = [
        (room, k.place)
        for k in posed.values()
        if (room := truth.room((k.run_id, k.keyframe_id))) is not None
    ]
    scores = agreement([room for room, _ in known], [place for _, place in known])
    rooms = {room for room, _ in known}
    noise = sum(k.place is None for k in posed.values())
    renamed = sum(k.place != first[i] for i, k in posed.items() if i in first)
    return PlaceScores(
        scores.v_measure,
        scores.homogeneity,
        scores.completeness,
        _share(noise, len(posed)),
        _share(late, len(posed)),
        _share(renamed, len(posed)),
        _share(len(view.places), len(rooms)),
        seconds,
    )


def places_table(rows: Sequence[PlacesRow]) -> str:
    """V of each rule, then the last rule's own figures; the worst line of that rule last, then
    means over the buildings."""
    names = list(rows[0].rules)
    heads = [*(f"V {name}" for name in names), "homog", "compl", "noise", "late", "renamed"]
    lines = [_line("profile world", ["kf", "rooms", *heads, "pl/room", "page s", "× cost"])]
    ordered = sorted(rows, key=lambda row: -row.rules[names[-1]].v_measure)
    lines += [_line(row.name, _cells([row])) for row in ordered]
    buildings = [row for row in ordered if row.name != HOUSE]
    if len(buildings) > 1:
        lines.append(_line("mean", _cells(buildings)))
        for part in (0, 1):
            for key in sorted({row.name.split()[part] for row in buildings}):
                own = [row for row in buildings if row.name.split()[part] == key]
                if len(own) not in (1, len(buildings)):
                    lines.append(_line(f"  {key}", _cells(own)))
        own = [row for row in buildings if row.walled is not None and row.walled >= LEAST_WALLED]
        if own:
            lines.append(_line("  rooms have walls", _cells(own)))
        for name in names:
            worst = min(buildings, key=lambda row: row.rules[name].v_measure)
            value = number(worst.rules[name].v_measure, 3)
            lines.append(f"worst {name}: {worst.name} {value}")
    return "\n".join(lines)


def _cells(rows: Sequence[PlacesRow]) -> list[str]:
    """Means of the rows; sums of keyframes, rooms and processor time."""
    *_, own = by_rule = [[row.rules[name] for row in rows] for name in rows[0].rules]
    page_s = sum(s.seconds for s in by_rule[0])
    return [
        str(sum(row.keyframes for row in rows)),
        str(sum(row.rooms for row in rows)),
        *(mean_of(scores, "v_measure", 3) for scores in by_rule),
        *(mean_of(own, field, 2 if field == "ratio" else 3) for field in _OWN),
        number(page_s, 2),
        number(sum(s.seconds for s in own) / page_s if page_s else math.nan, 2),
    ]


def _line(name: str, cells: Iterable[str]) -> str:
    return name.ljust(26) + " ".join(cell.rjust(8) for cell in cells)


def _share(part: int, whole: int) -> float:
    return part / whole if whole else 0.0
