"""A map as rows by id: what a difference between two maps is taken of.

Ids, not ordinals, so that the rows of two logs or two settings can stand side by side too.
"""

from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass
from typing import Generic, TypeAlias, TypeVar

from projections.view import MapView


@dataclass(frozen=True, slots=True)
class PlaceRow:
    """A standing place; its centroid in metres."""

    place_id: str
    centroid_x: float
    centroid_y: float
    keyframe_count: int


@dataclass(frozen=True, slots=True)
class ObjectRow:
    """An object; its mean position in metres, its sightings in order."""

    object_id: str
    class_name: str
    mean_x: float
    mean_y: float
    place_id: str | None
    first_seen: float
    last_seen: float
    det_ids: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class KeyframeRow:
    """A keyframe and its place; the pose is metres and radians, None when there was none."""

    run_id: str
    keyframe_id: int
    pose: tuple[float, float, float] | None
    place_id: str | None


@dataclass(frozen=True, slots=True)
class EdgeRow:
    """Two places next to each other."""

    a: str
    b: str
    shared_transitions: int


K = TypeVar("K", bound=Hashable)
R = TypeVar("R")


@dataclass(frozen=True, slots=True)
class Changes(Generic[K, R]):
    """What turns one table into another: rows that came, went, and changed (before, after)."""

    came: tuple[R, ...]
    went: tuple[R, ...]
    changed: tuple[tuple[R, R], ...]

    @property
    def none(self) -> bool:
        """Whether nothing changed."""
        return not (self.came or self.went or self.changed)

    def apply(self, rows: dict[K, R], key: Callable[[R], K]) -> dict[K, R]:
        """The table after the changes; ``rows`` is the one before."""
        gone = {key(row) for row in self.went}
        kept = {k: row for k, row in rows.items() if k not in gone}
        return kept | {key(after): after for _, after in self.changed} | _by(key, self.came)


def changes(before: dict[K, R], after: dict[K, R]) -> Changes[K, R]:
    """What turns ``before`` into ``after``, in the order of the tables."""
    return Changes(
        came=tuple(row for key, row in after.items() if key not in before),
        went=tuple(row for key, row in before.items() if key not in after),
        changed=tuple(
            (row, after[key]) for key, row in before.items() if key in after and after[key] != row
        ),
    )


Keyframes: TypeAlias = dict[tuple[str, int], KeyframeRow]
Edges: TypeAlias = dict[tuple[str, str], EdgeRow]


@dataclass(frozen=True, slots=True)
class MapRows:
    """A whole map by id."""

    keyframes: Keyframes
    places: dict[str, PlaceRow]
    objects: dict[str, ObjectRow]
    edges: Edges


def rows_of(view: MapView) -> MapRows:
    """The rows of a map, each table in the order of founding."""
    ids = [place.place_id for place in view.all_places]
    return MapRows(
        keyframes=_by(keyframe_key, _keyframes(view, ids)),
        places=_by(
            place_key,
            (
                PlaceRow(p.place_id, p.centroid_x, p.centroid_y, p.keyframe_count)
                for p in view.places.values()
            ),
        ),
        objects=_by(object_key, _objects(view, ids)),
        edges=_by(edge_key, (EdgeRow(ids[a], ids[b], n) for a, b, n in view.edges())),
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


def _keyframes(view: MapView, ids: list[str]) -> Iterable[KeyframeRow]:
    for k in view.keyframes:
        place = k.place
        pose = None if k.pose is None else (k.pose.x_um / 1e6, k.pose.y_um / 1e6, k.pose.yaw_rad)
        yield KeyframeRow(k.run_id, k.keyframe_id, pose, None if place is None else ids[place])


def _objects(view: MapView, ids: list[str]) -> Iterable[ObjectRow]:
    observations = view.observations
    for o in view.objects:
        yield ObjectRow(
            o.object_id,
            o.class_name,
            o.mean_x,
            o.mean_y,
            None if o.place is None else ids[o.place],
            o.first_seen,
            o.last_seen,
            tuple(observations[number].det_id for number in o.observations),
        )
