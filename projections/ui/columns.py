"""A map's whole history as columns, from which a browser makes the map at any offset by itself.

The columns are read from a `History`, which one fold has filled; nothing is folded here. Ordinals
of keyframes, places and objects are those of the fold: rows 0, 1, 2 … of ``kf_``, ``pf_`` and
``of_``. A ``start`` leaves out what events before it did; numbers stay the same, so that rows from
``start`` on are appended to those a client has.
"""

from collections.abc import Iterable, Sequence
from operator import attrgetter, itemgetter
from typing import Any, Final

import numpy as np

from eventsrc.envelope import Offset
from projections.deltas import KeyframeAdded
from projections.history.history import History
from projections.history.names import keyframe_name
from projections.history.records import count_before

from .binary import Column
from .log_events import LogEvents, event_columns
from .object_columns import class_names, object_columns

_INT32_MAX: Final = 2**31 - 1
_NEAR_M: Final = 4096.0
"""Within it of the origin a float32 is exact to half a millimetre."""
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
    """Where positions count from, metres: (0, 0), or a point near a first pose that is far off."""
    pose = next((k.pose for k in history.keyframes if k.pose is not None), None)
    if pose is None or max(abs(pose.x_m), abs(pose.y_m)) <= _NEAR_M:
        return 0.0, 0.0
    x, y = (round(metres / _ORIGIN_STEP_M) * _ORIGIN_STEP_M for metres in (pose.x_m, pose.y_m))
    return x, y


def _counts(history: History, start: Offset) -> dict[str, int]:
    """How many keyframes, places and objects there were before ``start``."""
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
