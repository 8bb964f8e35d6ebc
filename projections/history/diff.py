"""The difference between two maps; applied to the first it gives the second.

Maps are compared as rows by id, not by ordinal, so that maps of two logs or two settings, or under
other commands, can be compared too.
"""

import math
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeAlias, TypeVar

import msgspec

from eventsrc.envelope.model import Offset, RunId
from projections.ask.object_changes import (
    ObjectChanges,
    ObjectRow,
    became,
    changes_document,
    object_document,
    object_rows,
    object_shift_m,
)
from projections.fold.corrections import RecordedCommand
from projections.map.digest import map_digest
from projections.map.naming import ShortIds, things_of
from projections.map.phrases import command_document
from projections.map.records import KeyframeRecord
from projections.map.view import MapView
from projections.store.history_records import Cause


@dataclass(frozen=True, slots=True)
class PlaceRow:
    """A place that is not absorbed; its centroid in metres, its name if it has one."""

    place_id: str
    centroid_x: float
    centroid_y: float
    keyframe_count: int
    name: str | None = None


class KeyframeRow(msgspec.Struct, frozen=True, gc=False):
    """A keyframe and its place; the pose is metres and radians, None when there was none."""

    run_id: RunId
    keyframe_id: int
    pose: tuple[float, float, float] | None
    place_id: str | None


@dataclass(frozen=True, slots=True)
class EdgeRow:
    """Two adjacent places."""

    a: str
    b: str
    shared_transitions: int


K = TypeVar("K", bound=Hashable)
R = TypeVar("R")


@dataclass(frozen=True, slots=True)
class Changes(Generic[K, R]):
    """Differences of two tables: rows added, removed, and changed (before, after)."""

    added: tuple[R, ...]
    removed: tuple[R, ...]
    changed: tuple[tuple[R, R], ...]

    @property
    def none(self) -> bool:
        """Whether nothing changed."""
        return not (self.added or self.removed or self.changed)

    def apply(self, rows: dict[K, R], key: Callable[[R], K]) -> dict[K, R]:
        """The table after the changes; ``rows`` is the one before."""
        removed = {key(row) for row in self.removed}
        kept = {k: row for k, row in rows.items() if k not in removed}
        return kept | {key(after): after for _, after in self.changed} | _by(key, self.added)


def changes(before: dict[K, R], after: dict[K, R]) -> Changes[K, R]:
    """The differences of two tables by key, in the order of the tables."""
    return Changes(
        added=tuple(row for key, row in after.items() if key not in before),
        removed=tuple(row for key, row in before.items() if key not in after),
        changed=tuple(
            (row, after[key]) for key, row in before.items() if key in after and after[key] != row
        ),
    )


Keyframes: TypeAlias = dict[tuple[str, int], KeyframeRow]
Edges: TypeAlias = dict[tuple[str, str], EdgeRow]


@dataclass(frozen=True, slots=True)
class MapRows:
    """The tables of a map, by id."""

    keyframes: Keyframes
    places: dict[str, PlaceRow]
    objects: dict[str, ObjectRow]
    edges: Edges


def rows_of(view: MapView) -> MapRows:
    """The rows of a map, each table in the order of the view."""
    return MapRows(
        keyframes=_by(keyframe_key, _keyframe_rows(view, view.keyframes)),
        places=_place_table(view),
        objects=object_rows(view),
        edges=_edge_table(view),
    )


def keyframe_key(row: KeyframeRow) -> tuple[str, int]:
    return row.run_id, row.keyframe_id


def place_key(row: PlaceRow) -> str:
    return row.place_id


def object_key(row: ObjectRow) -> str:
    return row.object_id


def edge_key(row: EdgeRow) -> tuple[str, str]:
    return row.a, row.b


def _by(key: Callable[[R], K], rows: Iterable[R]) -> dict[K, R]:
    return {key(row): row for row in rows}


def _keyframe_rows(view: MapView, keyframes: Iterable[KeyframeRecord]) -> Iterator[KeyframeRow]:
    ids = [place.place_id for place in view.all_places]
    for k in keyframes:
        place = k.place
        pose = None if k.pose is None else (k.pose.x_um / 1e6, k.pose.y_um / 1e6, k.pose.yaw_rad)
        yield KeyframeRow(k.run_id, k.keyframe_id, pose, None if place is None else ids[place])


def _place_table(view: MapView) -> dict[str, PlaceRow]:
    return {
        p.place_id: PlaceRow(p.place_id, p.centroid_x, p.centroid_y, p.keyframe_count, p.name)
        for p in view.places.values()
    }


def _edge_table(view: MapView) -> Edges:
    ids = [place.place_id for place in view.all_places]
    return _by(edge_key, (EdgeRow(ids[a], ids[b], n) for a, b, n in view.edges()))


@dataclass(frozen=True, slots=True)
class Difference:
    """The difference of the map after ``start`` events and that after ``end``.

    ``absorbed`` gives, by id of an absorbed place, the surviving place and the cause; it is empty
    when ``end`` < ``start``. ``became`` is about the changed objects. ``short_ids`` are of both
    maps together. ``commands`` are those that one of the maps knows and the other not.
    """

    start: Offset
    end: Offset
    digests: tuple[str, str]
    counts: tuple[dict[str, int], dict[str, int]]
    keyframes: Changes[tuple[str, int], KeyframeRow]
    places: Changes[str, PlaceRow]
    objects: Changes[str, ObjectRow]
    edges: Changes[tuple[str, str], EdgeRow]
    absorbed: dict[str, tuple[str, Cause]]
    became: ObjectChanges
    short_ids: ShortIds
    commands: tuple[RecordedCommand, ...] = ()

    @property
    def same(self) -> bool:
        """Whether the two maps are equal, by their digests."""
        return self.digests[0] == self.digests[1]

    def apply(self, rows: MapRows) -> MapRows:
        """The second map's rows, from the first one's."""
        return MapRows(
            keyframes=self.keyframes.apply(rows.keyframes, keyframe_key),
            places=self.places.apply(rows.places, place_key),
            objects=self.objects.apply(rows.objects, object_key),
            edges=self.edges.apply(rows.edges, edge_key),
        )

    def document(self) -> dict[str, Any]:
        """JSON: the digests first, then what changed in each table."""
        return {
            "from": self.start,
            "to": self.end,
            "same": self.same,
            "digests": list(self.digests),
            "counts": self._counts(),
            "places": self._places(),
            "objects": _objects(self.objects, self.became),
            "keyframes": _keyframes(self.keyframes),
            "adjacency": _edges(self.edges),
            **({"commands": list(map(command_document, self.commands))} if self.commands else {}),
        }

    def _counts(self) -> dict[str, list[int]]:
        """The counts of both maps by name; one that a map does not have counts as 0 there."""
        first, second = self.counts
        names = dict.fromkeys((*first, *second))
        return {name: [first.get(name, 0), second.get(name, 0)] for name in names}

    def _places(self) -> dict[str, Any]:
        return {
            "formed": [_place(row) for row in self.places.added],
            "gone": [
                {**_place(row), **_into(self.absorbed.get(row.place_id))}
                for row in self.places.removed
            ],
            "changed": [
                {
                    "place_id": before.place_id,
                    "before": _place(before),
                    "after": _place(after),
                    "moved_m": place_shift_m(before, after),
                }
                for before, after in self.places.changed
            ],
        }


def difference_of(
    first: MapView,
    second: MapView,
    absorbed: dict[str, tuple[str, Cause]],
    commands: Sequence[RecordedCommand],
) -> Difference:
    """The difference of two maps."""
    before, after = rows_of(first), rows_of(second)
    objects = changes(before.objects, after.objects)
    return Difference(
        start=first.next_offset,
        end=second.next_offset,
        digests=(map_digest(first), map_digest(second)),
        counts=(first.counts(), second.counts()),
        keyframes=changes(before.keyframes, after.keyframes),
        places=changes(before.places, after.places),
        objects=objects,
        edges=changes(before.edges, after.edges),
        absorbed=absorbed,
        became=became(first, second, before.objects, after.objects),
        short_ids=ShortIds.of([*things_of(first), *things_of(second)]),
        commands=tuple(commands),
    )


def place_shift_m(before: PlaceRow, after: PlaceRow) -> float:
    """The distance between two centroids in metres."""
    return math.hypot(after.centroid_x - before.centroid_x, after.centroid_y - before.centroid_y)


def _place(row: PlaceRow) -> dict[str, Any]:
    return {
        "place_id": row.place_id,
        "centroid_x": row.centroid_x,
        "centroid_y": row.centroid_y,
        "keyframe_count": row.keyframe_count,
        **({} if row.name is None else {"name": row.name}),
    }


def _into(absorbed: tuple[str, Cause] | None) -> dict[str, Any]:
    return {} if absorbed is None else {"into": absorbed[0], "by": absorbed[1].document()}


def _objects(found: Changes[str, ObjectRow], became: ObjectChanges) -> dict[str, Any]:
    joined = became.joined
    return {
        "new": [{**object_document(row), "det_ids": list(row.det_ids)} for row in found.added],
        "gone": [
            object_document(row)
            | ({"into": joined[row.object_id]} if row.object_id in joined else {})
            for row in found.removed
        ],
        "changed": [
            {
                "object_id": before.object_id,
                "before": object_document(before),
                "after": object_document(after),
                "moved_m": object_shift_m(before, after),
                "relocated": before.place_id != after.place_id,
                "new_det_ids": list(after.det_ids[len(before.det_ids) :]),
            }
            for before, after in found.changed
        ],
        **changes_document(became),
    }


def _keyframes(found: Changes[tuple[str, int], KeyframeRow]) -> dict[str, Any]:
    return {
        "new": [_keyframe(row) for row in found.added],
        "gone": [_keyframe(row) for row in found.removed],
        "changed": [
            {**_keyframe(after), "before": before.place_id} for before, after in found.changed
        ],
    }


def _keyframe(row: KeyframeRow) -> dict[str, Any]:
    x, y, yaw = row.pose or (None, None, None)
    return {
        "run_id": row.run_id,
        "keyframe_id": row.keyframe_id,
        "map_x": x,
        "map_y": y,
        "map_yaw": yaw,
        "place_id": row.place_id,
    }


def _edges(found: Changes[tuple[str, str], EdgeRow]) -> list[dict[str, Any]]:
    added = [(row, 0, row.shared_transitions) for row in found.added]
    removed = [(row, row.shared_transitions, 0) for row in found.removed]
    changed = [(b, b.shared_transitions, a.shared_transitions) for b, a in found.changed]
    return [
        {"a": row.a, "b": row.b, "before": b, "after": a} for row, b, a in added + removed + changed
    ]
