"""What is different between two maps: a difference applied to the first gives the second."""

import math
from dataclasses import dataclass
from typing import Any

from .causes import Cause
from .rows import (
    Changes,
    EdgeRow,
    KeyframeRow,
    MapRows,
    ObjectRow,
    PlaceRow,
    changes,
    edge_key,
    keyframe_key,
    object_key,
    place_key,
)


@dataclass(frozen=True, slots=True)
class Difference:
    """What turns the map after ``start`` events into that after ``end``.

    ``absorbed`` says into which place, and because of what, a place went that is gone; it is empty
    when time runs backwards (``end`` < ``start``).
    """

    start: int
    end: int
    digests: tuple[str, str]
    counts: tuple[dict[str, int], dict[str, int]]
    keyframes: Changes[tuple[str, int], KeyframeRow]
    places: Changes[str, PlaceRow]
    objects: Changes[str, ObjectRow]
    edges: Changes[tuple[str, str], EdgeRow]
    absorbed: dict[str, tuple[str, Cause]]

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
            "counts": {name: [n, self.counts[1][name]] for name, n in self.counts[0].items()},
            "places": self._places(),
            "objects": _objects(self.objects),
            "keyframes": _keyframes(self.keyframes),
            "adjacency": _edges(self.edges),
        }

    def _places(self) -> dict[str, Any]:
        return {
            "formed": [_place(row) for row in self.places.came],
            "gone": [
                {**_place(row), **_into(self.absorbed.get(row.place_id))}
                for row in self.places.went
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
    start: int,
    end: int,
    rows: tuple[MapRows, MapRows],
    digests: tuple[str, str],
    counts: tuple[dict[str, int], dict[str, int]],
    absorbed: dict[str, tuple[str, Cause]],
) -> Difference:
    """Take the difference of two maps given as rows."""
    before, after = rows
    return Difference(
        start=start,
        end=end,
        digests=digests,
        counts=counts,
        keyframes=changes(before.keyframes, after.keyframes),
        places=changes(before.places, after.places),
        objects=changes(before.objects, after.objects),
        edges=changes(before.edges, after.edges),
        absorbed=absorbed,
    )


def place_shift_m(before: PlaceRow, after: PlaceRow) -> float:
    """How far a centroid moved."""
    return math.hypot(after.centroid_x - before.centroid_x, after.centroid_y - before.centroid_y)


def object_shift_m(before: ObjectRow, after: ObjectRow) -> float:
    """How far a mean position moved."""
    return math.hypot(after.mean_x - before.mean_x, after.mean_y - before.mean_y)


def _place(row: PlaceRow) -> dict[str, Any]:
    return {
        "place_id": row.place_id,
        "centroid_x": row.centroid_x,
        "centroid_y": row.centroid_y,
        "keyframe_count": row.keyframe_count,
    }


def _into(absorbed: tuple[str, Cause] | None) -> dict[str, Any]:
    return {} if absorbed is None else {"into": absorbed[0], "by": absorbed[1].document()}


def _object(row: ObjectRow) -> dict[str, Any]:
    return {
        "object_id": row.object_id,
        "class_name": row.class_name,
        "mean_x": row.mean_x,
        "mean_y": row.mean_y,
        "obs_count": len(row.det_ids),
        "place_id": row.place_id,
        "first_seen": row.first_seen,
        "last_seen": row.last_seen,
    }


def _objects(found: Changes[str, ObjectRow]) -> dict[str, Any]:
    return {
        "new": [{**_object(row), "det_ids": list(row.det_ids)} for row in found.came],
        "gone": [_object(row) for row in found.went],
        "changed": [
            {
                "object_id": before.object_id,
                "before": _object(before),
                "after": _object(after),
                "moved_m": object_shift_m(before, after),
                "relocated": before.place_id != after.place_id,
                "new_det_ids": list(after.det_ids[len(before.det_ids) :]),
            }
            for before, after in found.changed
        ],
    }


def _keyframes(found: Changes[tuple[str, int], KeyframeRow]) -> dict[str, Any]:
    return {
        "new": [_keyframe(row) for row in found.came],
        "gone": [_keyframe(row) for row in found.went],
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
    came = [(row, 0, row.shared_transitions) for row in found.came]
    went = [(row, row.shared_transitions, 0) for row in found.went]
    changed = [(b, b.shared_transitions, a.shared_transitions) for b, a in found.changed]
    return [
        {"a": row.a, "b": row.b, "before": b, "after": a} for row, b, a in came + went + changed
    ]
