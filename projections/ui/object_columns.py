"""What happened to objects, as columns: a row for each event that changed one, with its new values.

A row has all values of the object after the event: where it stands, how often it was seen, its
class, its place and whether it is missing. So the last row below W is the object at W.
"""

from collections.abc import Callable, Iterator, Sequence
from math import nan
from operator import itemgetter
from typing import Any, Final, NamedTuple

import numpy as np

from eventsrc.envelope import Offset
from projections.deltas import ObjectEstimated, ObjectSeen, ObjectsMerged
from projections.exact import UM_PER_M, mean_m
from projections.history.history import History
from projections.history.records import ObjectHistory, count_before

from .binary import Column

_UM2_PER_M2: Final = float(UM_PER_M) ** 2


class ObjectRow(NamedTuple):
    """An object after the event at ``offset``; metres and square metres in the map frame.

    ``x`` and ``y`` are its estimate, the mean of where it was seen from without one; the variances
    are NaN then. ``class_number`` is an index of the class names, ``place`` -1 for none.
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
    """The classes that objects have had, in the order in which events named them first.

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
    """What changed the object, by offset."""
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
