"""A map's whole history as columns, from which the page computes the map at any offset.

The columns are read from a `History`, which one fold has filled; nothing is folded here. Ordinals
of keyframes, places and objects are those of the fold: rows 0, 1, 2 … of ``kf_``, ``pf_`` and
``of_``. Objects have a row for each event that changed one, with all values of the object after it.
With a ``start``, rows of earlier events are left out; numbers stay the same, so that a client can
append the rows to those it has.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from math import nan
from operator import attrgetter, itemgetter
from typing import Any, Final, NamedTuple

import numpy as np

from eventsrc.envelope.model import Offset
from projections.fold.deltas import KeyframeAdded, ObjectEstimated, ObjectSeen, ObjectsMerged
from projections.fold.exact import UM_PER_M, mean_m
from projections.history.names import keyframe_name
from projections.store.history import History
from projections.store.records import ObjectHistory, count_before

from .binary import Column
from .log_events import LogEvents, event_columns

_UM2_PER_M2: Final = float(UM_PER_M) ** 2


class ObjectRow(NamedTuple):
    """An object after the event at ``offset``; metres and square metres in the map frame.

    ``x`` and ``y`` are its estimate; without one, the mean of the positions it was seen from, with
    NaN as variances. ``class_number`` is an index of the class names, ``place`` -1 for none.
    """

    offset: int
    object: int
    x: float
    y: float
    xx: float
    xy: float
    yy: float
    seen: int
    class_number: int
    place: int
    missing: int


_COLUMNS: Final = (
    ("oc_offset", "<i4"), ("oc_object", "<i4"), ("oc_x", "<f8"), ("oc_y", "<f8"),
    ("oc_xx", "<f4"), ("oc_xy", "<f4"), ("oc_yy", "<f4"), ("oc_count", "<i4"),
    ("oc_class", "<i4"), ("oc_place", "<i4"), ("oc_missing", "|u1"),
)  # fmt: skip


def class_names(history: History) -> list[str]:
    """The classes that objects have had, in the order of their first events.

    So a longer history only adds names at the end.
    """
    named = [(each.found.offset, each.found.class_name) for each in history.objects]
    named += [(c.offset, c.class_name) for each in history.objects for c in each.classes]
    named.sort(key=itemgetter(0))
    return list(dict.fromkeys(name for _, name in named))


def object_columns(
    history: History, start: Offset, classes: Sequence[str], origin: tuple[float, float]
) -> dict[str, Column]:
    """The columns of objects, of their changes and of their merges, from offset ``start`` on."""
    numbers = {name: number for number, name in enumerate(classes)}
    found = [each.found for each in history.objects if each.found.offset >= start]
    rows = [
        row
        for each in history.objects
        for row in object_rows(each, start, numbers.__getitem__)
    ]  # fmt: skip
    rows.sort(key=itemgetter(0))  # stable: objects in order within an event
    values = list(zip(*rows, strict=True)) if rows else [()] * len(_COLUMNS)
    merges = history.object_merges[count_before(history.object_merges, start) :]
    columns = {
        "of_offset": np.array([each.offset for each in found], "<i4"),
        "of_object": np.array([each.object for each in found], "<i4"),
        "of_class": np.array([numbers[each.class_name] for each in found], "<i4"),
        **{
            name: np.array(column, code)
            for (name, code), column in zip(_COLUMNS, values, strict=True)
        },
        "om_offset": np.array([merge.offset for merge in merges], "<i4"),
        "om_survivor": np.array([merge.survivor for merge in merges], "<i4"),
        "om_absorbed": np.array([merge.absorbed for merge in merges], "<i4"),
    }
    for name, shift in zip(("oc_x", "oc_y"), origin, strict=True):
        columns[name] = (columns[name] - shift).astype("<f4")
    return columns


def object_rows(
    record: ObjectHistory, start: Offset, class_number: Callable[[str], int]
) -> Iterator[ObjectRow]:
    """A row for each event from ``start`` on that changed the object."""
    if not _last_offset(record) >= start:
        return
    state = _State(record.found.object, class_number(record.found.class_name), class_number)
    changes = _changes(record)
    for index, (offset, delta, apply) in enumerate(changes):
        apply(state, delta)
        is_last = index + 1 == len(changes) or changes[index + 1][0] != offset
        if is_last and offset >= start:
            yield state.row(offset)


class _State:
    """The values of an object while its changes are applied, as `ObjectHistory` reads them."""

    def __init__(self, number: int, class_number: int, number_of: Callable[[str], int]) -> None:
        self._object, self._class, self._number_of = number, class_number, number_of
        self._seen: ObjectSeen | None = None
        self._merged: ObjectsMerged | None = None
        self._estimate: ObjectEstimated | None = None
        self._place = -1
        self._missing, self._moved_at, self._missing_at = False, -1, -1

    def see(self, delta: Any) -> None:
        self._seen = delta

    def fuse(self, merge: Any) -> None:
        self._merged = merge.values

    def classify(self, delta: Any) -> None:
        self._class = self._number_of(delta.class_name)

    def estimate(self, delta: Any) -> None:
        self._estimate = delta

    def miss(self, delta: Any) -> None:
        self._missing, self._missing_at = delta.missing, delta.offset

    def relocate(self, delta: Any) -> None:
        self._moved_at = delta.offset

    def locate(self, delta: Any) -> None:
        self._place = -1 if delta.place is None else delta.place

    def row(self, offset: int) -> ObjectRow:
        values: ObjectSeen | ObjectsMerged | None = self._seen
        if self._merged is not None and not (
            values is not None and values.obs_count > self._merged.obs_count
        ):
            values = self._merged
        x = y = xx = xy = yy = nan
        if (at := self._estimate) is not None:
            x, y = at.x_um / UM_PER_M, at.y_um / UM_PER_M
            xx, xy = at.var_xx_um2 / _UM2_PER_M2, at.var_xy_um2 / _UM2_PER_M2
            yy = at.var_yy_um2 / _UM2_PER_M2
        elif values is not None:
            x = mean_m(values.sum_x_um, values.obs_count)
            y = mean_m(values.sum_y_um, values.obs_count)
        count = 0 if values is None else values.obs_count
        missing = self._missing and self._moved_at <= self._missing_at
        return ObjectRow(
            offset, self._object, x, y, xx, xy, yy, count, self._class, self._place, int(missing)
        )


_Apply = Callable[[_State, Any], None]


def _changes(record: ObjectHistory) -> list[tuple[int, Any, _Apply]]:
    """The changes of the object, by offset."""
    found: list[tuple[int, Any, _Apply]] = []
    kinds: tuple[tuple[Sequence[Any], _Apply], ...] = (
        (record.sightings, _State.see),
        (record.merges, _State.fuse),
        (record.relocations, _State.relocate),
        (record.classes, _State.classify),
        (record.estimates, _State.estimate),
        (record.misses, _State.miss),
        (record.moves, _State.locate),
    )
    for deltas, apply in kinds:
        found += [(delta.offset, delta, apply) for delta in deltas]
    found.sort(key=itemgetter(0))
    return found


def _last_offset(record: ObjectHistory) -> int:
    """The last event that changed the object."""
    lists: tuple[Sequence[Any], ...] = (
        record.sightings, record.merges, record.relocations, record.classes, record.estimates,
        record.misses, record.moves,
    )  # fmt: skip
    return max((each[-1].offset for each in lists if each), default=-1)


_INT32_MAX: Final = 2**31 - 1
_NEAR_M: Final = 4096.0
"""Distance from the origin within which a float32 is exact to half a millimetre."""
_ORIGIN_STEP_M: Final = 1000.0


def history_columns(
    history: History, start: Offset, log_events: LogEvents
) -> tuple[dict[str, Any], dict[str, Column]]:
    """The header and the columns of everything that the events from ``start`` on did.

    ``strings`` of the header are those that are new since ``start``; ``first`` says how many there
    were before. Positions are metres from ``origin``, which is (0, 0) unless the map is so far off
    that float32 would be too coarse.
    """
    origin = map_origin(history)
    classes = class_names(history)
    first = _counts(history, start) | {"system": log_events.count_before(start)}
    keyframes = history.keyframes[first["keyframe"] :]
    places = history.places[first["place_id"] :]
    objects = history.objects[first["object_id"] :]
    ids = all(_fits(k) for k in history.keyframes)
    floors = _floor_numbers(history)
    header = {
        "from": start,
        "through": history.next_offset,
        "origin": list(origin),
        "first": first,
        "strings": {
            "place_id": [place.place_id for place in places],
            "place_founder": [keyframe_name(history, p.formed.founder) for p in places],
            "object_id": [each.object_id for each in objects],
            "class": classes,
            "run_id": [seen[0].run_id for seen in history.runs],
            "floor": list(floors),
        },
        "names": _names(history, start),
        "kf_number_is_id": ids,
    }
    events, event_header = event_columns(history, start, log_events)
    columns = {
        **_keyframe_columns(keyframes, origin, ids=ids),
        "kf_floor": _ints(-1 if k.floor is None else floors[k.floor] for k in keyframes),
        **_place_columns(history, start),
        **object_columns(history, start, classes, origin),
        **_adjacency_columns(history, start),
        **events,
    }
    return header | event_header, columns


def map_origin(history: History) -> tuple[float, float]:
    """The origin of positions in metres: (0, 0), or a point near the first pose if that is far
    off."""
    pose = next((k.pose for k in history.keyframes if k.pose is not None), None)
    if pose is None or max(abs(pose.x_m), abs(pose.y_m)) <= _NEAR_M:
        return 0.0, 0.0
    x, y = (round(metres / _ORIGIN_STEP_M) * _ORIGIN_STEP_M for metres in (pose.x_m, pose.y_m))
    return x, y


def _counts(history: History, start: Offset) -> dict[str, int]:
    """The numbers of keyframes, places and objects before ``start``."""
    return {
        "keyframe": history.keyframe_count(start),
        "place_id": sum(place.formed.offset < start for place in history.places),
        "object_id": sum(each.found.offset < start for each in history.objects),
        "refusals": sum(refusal.cause.offset < start for refusal in history.refusals),
    }


def _floor_numbers(history: History) -> dict[str, int]:
    """The floors that have a name, numbered by their first keyframe."""
    names = (k.floor for k in history.keyframes if k.floor is not None)
    return {name: number for number, name in enumerate(dict.fromkeys(names))}


def _fits(keyframe: KeyframeAdded) -> bool:
    return 0 <= keyframe.keyframe_id <= _INT32_MAX


def _keyframe_columns(
    keyframes: Sequence[KeyframeAdded], origin: tuple[float, float], *, ids: bool
) -> dict[str, Column]:
    nowhere = (np.nan, np.nan, np.nan)
    poses = [
        nowhere if k.pose is None else (k.pose.x_m, k.pose.y_m, k.pose.yaw_rad) for k in keyframes
    ]
    where = np.array(poses, "<f8").reshape(-1, 3) - np.array((*origin, 0.0))
    numbers = [k.keyframe_id if ids else k.keyframe for k in keyframes]
    return {
        "kf_offset": _ints(k.offset for k in keyframes),
        "kf_run": _ints(k.run for k in keyframes),
        "kf_x": where[:, 0].astype("<f4"),
        "kf_y": where[:, 1].astype("<f4"),
        "kf_yaw": where[:, 2].astype("<f4"),
        "kf_stamp": np.array([k.timestamp for k in keyframes], "<f8"),
        "kf_number": _ints(numbers),
        "kf_id": np.array([k.keyframe_id for k in keyframes], "<i8"),
    }


def _place_columns(history: History, start: Offset) -> dict[str, Column]:
    placed = [
        delta
        for place in history.places
        for delta in place.joined[count_before(place.joined, start) :]
    ]
    placed.sort(key=attrgetter("offset", "keyframe"))
    formed = [place.formed for place in history.places if place.formed.offset >= start]
    merged = [
        (merge.cause.offset, merge.survivor, place, merge.bridge)
        for merge in history.merges
        if merge.cause.offset >= start
        for place in merge.absorbed
    ]
    return {
        "pl_offset": _ints(delta.offset for delta in placed),
        "pl_keyframe": _ints(delta.keyframe for delta in placed),
        "pl_place": _ints(delta.place for delta in placed),
        "pf_offset": _ints(delta.offset for delta in formed),
        "pf_place": _ints(delta.place for delta in formed),
        "pf_founder": _ints(delta.founder for delta in formed),
        **_by_name(("mg_offset", "mg_survivor", "mg_absorbed", "mg_keyframe"), merged),
    }


def _names(history: History, start: Offset) -> list[dict[str, Any]]:
    """The names that places got from ``start`` on; None where one lost its name."""
    named = [
        {"offset": delta.offset, "place": delta.place, "name": delta.name}
        for place in history.places
        for delta in place.names
        if delta.offset >= start
    ]
    named.sort(key=itemgetter("offset"))
    return named


def _adjacency_columns(history: History, start: Offset) -> dict[str, Column]:
    rows = [
        (linked.offset, linked.a, linked.b, linked.shared_transitions)
        for changes in history.edges.values()
        for linked in changes[count_before(changes, start) :]
    ]
    rows.sort(key=itemgetter(0))  # stable: the last row of an event and a pair counts
    return _by_name(("ad_offset", "ad_a", "ad_b", "ad_count"), rows)


def _by_name(names: Sequence[str], rows: Sequence[Sequence[int]]) -> dict[str, Column]:
    """A column of int32 for each name, from rows in the order of the names."""
    table = np.array(rows, "<i4").reshape(-1, len(names))
    return {name: np.ascontiguousarray(table[:, i]) for i, name in enumerate(names)}


def _ints(values: Iterable[int]) -> Column:
    return np.fromiter(values, "<i4")
