"""A map as one scene of Foxglove's 3D panel.

Every scene is whole: it begins by deleting what was shown. After a seek Foxglove shows the last
message of each topic, so a scene with only the changes would leave the rest out.
"""

from collections.abc import Iterable, Iterator
from typing import Final, TypedDict

from foxglove.messages import (
    Color,
    CubePrimitive,
    KeyValuePair,
    LinePrimitive,
    LinePrimitiveLineType,
    Point3,
    Pose,
    Quaternion,
    SceneEntity,
    SceneEntityDeletion,
    SceneEntityDeletionType,
    SceneUpdate,
    SpherePrimitive,
    TextPrimitive,
    Timestamp,
    TriangleListPrimitive,
    Vector3,
)

from projections.adapters.export import Point, hull
from projections.adapters.palette import place_colour
from projections.fold.deltas import PlaceOrdinal, PlacesMerged
from projections.map.view import MapView

FRAME: Final = "map"
FLOOR_M: Final = 3.0
"""Height of a floor above the one before, in the order in which the log met them."""
_MOST_PATH_POINTS: Final = 2_000
_SECOND_NS: Final = 1_000_000_000
_INK: Final = Color(r=0.15, g=0.15, b=0.18, a=1.0)
_GREY: Final = Color(r=0.45, g=0.45, b=0.5, a=0.8)
_RED: Final = Color(r=0.85, g=0.1, b=0.15, a=0.9)


def timestamp(time_ns: int) -> Timestamp:
    """Foxglove's form of a time; before 1970 there is none, so 1970 is as early as it gets."""
    return Timestamp(sec=max(time_ns, 0) // _SECOND_NS, nsec=max(time_ns, 0) % _SECOND_NS)


def map_scene(view: MapView, merges: Iterable[PlacesMerged], time_ns: int) -> SceneUpdate:
    """Places with outline and name, Objects, adjacency, the path of each run, and a mark where each
    of ``merges`` happened; entities in that order, those of a kind by ordinal."""
    now = timestamp(time_ns)
    parts = [*_places(view), *_objects(view), *_ways(view), *_paths(view), *_merges(view, merges)]
    return SceneUpdate(
        deletions=[SceneEntityDeletion(timestamp=now, type=SceneEntityDeletionType.All)],
        entities=[
            SceneEntity(timestamp=now, frame_id=FRAME, id=name, **shapes) for name, shapes in parts
        ],
    )


class _Shapes(TypedDict, total=False):
    """Fields of an entity."""

    metadata: list[KeyValuePair]
    cubes: list[CubePrimitive]
    spheres: list[SpherePrimitive]
    lines: list[LinePrimitive]
    triangles: list[TriangleListPrimitive]
    texts: list[TextPrimitive]


_Part = tuple[str, _Shapes]
"""An entity's id and its fields."""


def _places(view: MapView) -> Iterator[_Part]:
    for place in view.places.values():
        z = height(view, view.floor_of(place.ordinal))
        ring = hull(view.keyframes[member].pose for member in place.members)
        colour = _colour(place.ordinal)
        corners = [Point3(x=x, y=y, z=z) for x, y in ring]
        kind = view.type_of(place.ordinal)
        label = place.name or (kind.type if kind is not None else None)
        shapes: _Shapes = {
            "metadata": _metadata(
                place_id=place.place_id, keyframes=place.keyframe_count, name=place.name
            ),
            "texts": [
                _text(
                    place.place_id if label is None else f"{label} ({place.place_id})",
                    (place.centroid_x, place.centroid_y),
                    z + 0.3,
                    0.35,
                )
            ],
        }
        if len(corners) > 2:
            fan = [i for corner in range(1, len(corners) - 1) for i in (0, corner, corner + 1)]
            shapes["triangles"] = [
                TriangleListPrimitive(
                    pose=_at(0.0, 0.0, 0.0),
                    points=corners,
                    indices=fan,
                    color=_colour(place.ordinal, 0.3),
                )
            ]
            shapes["lines"] = [
                LinePrimitive(
                    type=LinePrimitiveLineType.LineLoop,
                    pose=_at(0.0, 0.0, 0.0),
                    thickness=0.05,
                    points=corners,
                    color=colour,
                )
            ]
        else:
            shapes["spheres"] = [
                SpherePrimitive(
                    pose=_at(place.centroid_x, place.centroid_y, z),
                    size=Vector3(x=0.3, y=0.3, z=0.3),
                    color=colour,
                )
            ]
        yield f"place/{place.place_id}", shapes


def _objects(view: MapView) -> Iterator[_Part]:
    for found in view.objects.values():
        x, y = found.spot
        founder = view.keyframes[view.observations[found.observations[0]].keyframe]
        z = height(view, founder.floor) + 0.2
        colour = _GREY if found.place is None else _colour(found.place)
        missing = found.missing_in is not None
        yield (
            f"object/{found.object_id}",
            {
                "metadata": _metadata(
                    object_id=found.object_id,
                    class_name=found.class_name,
                    observations=found.obs_count,
                    place_id=view.place_id(found.place),
                    sigma_m=None if found.estimate is None else found.estimate.est_sigma_m,
                    missing=True if missing else None,
                ),
                "cubes": [
                    CubePrimitive(
                        pose=_at(x, y, z),
                        size=Vector3(x=0.2, y=0.2, z=0.2),
                        color=_RED if missing else colour,
                    )
                ],
                "texts": [
                    _text(
                        f"{found.class_name} (missing)" if missing else found.class_name,
                        (x, y),
                        z + 0.25,
                        0.18,
                    )
                ],
            },
        )


def _ways(view: MapView) -> Iterator[_Part]:
    lines: list[LinePrimitive] = []
    for a, b, transitions in view.edges():
        ends = [view.places[each] for each in (a, b)]
        points = [
            Point3(x=end.centroid_x, y=end.centroid_y, z=height(view, view.floor_of(end.ordinal)))
            for end in ends
        ]
        lines.append(
            LinePrimitive(
                type=LinePrimitiveLineType.LineStrip,
                pose=_at(0.0, 0.0, 0.1),
                thickness=min(0.05 * transitions, 0.25),
                points=points,
                color=_INK,
            )
        )
    if lines:
        yield "adjacency", {"lines": lines}


def _paths(view: MapView) -> Iterator[_Part]:
    points: dict[str, list[Point3]] = {run.run_id: [] for run in view.runs}
    for k in view.keyframes:
        if k.pose is not None:
            z = height(view, k.floor)
            points[k.run_id].append(Point3(x=k.pose.x_m, y=k.pose.y_m, z=z))
    for run_id, path in points.items():
        step = -(-len(path) // _MOST_PATH_POINTS)
        if len(path) > 1:
            line = LinePrimitive(
                type=LinePrimitiveLineType.LineStrip,
                pose=_at(0.0, 0.0, 0.05),
                thickness=0.03,
                points=[*path[:-1:step], path[-1]],
                color=_GREY,
            )
            yield f"path/{run_id}", {"lines": [line]}


def _merges(view: MapView, merges: Iterable[PlacesMerged]) -> Iterator[_Part]:
    for merge in merges:
        bridge = view.keyframes[merge.bridge]
        if bridge.pose is None:
            continue
        absorbed = ", ".join(view.all_places[place].place_id for place in merge.absorbed)
        label = f"{absorbed} → {view.place_id(merge.survivor)}"
        where = bridge.pose.x_m, bridge.pose.y_m
        z = height(view, bridge.floor) + 0.1
        yield (
            f"merge/{merge.offset}",
            {
                "metadata": _metadata(
                    offset=merge.offset, bridge=f"{bridge.run_id}:{bridge.keyframe_id}"
                ),
                "spheres": [
                    SpherePrimitive(
                        pose=_at(*where, z), size=Vector3(x=0.3, y=0.3, z=0.3), color=_RED
                    )
                ],
                "texts": [_text(label, where, z + 0.3, 0.2)],
            },
        )


def height(view: MapView, floor: str | None) -> float:
    """The height at which a floor is shown, metres; that of poses without a floor's name is 0."""
    return 0.0 if floor is None else FLOOR_M * view.floors.get(floor, 0)


def _colour(place: PlaceOrdinal, alpha: float = 1.0) -> Color:
    colour = place_colour(place)
    red, green, blue = (int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5))
    return Color(r=red, g=green, b=blue, a=alpha)


def _at(x: float, y: float, z: float) -> Pose:
    return Pose(position=Vector3(x=x, y=y, z=z), orientation=Quaternion(x=0.0, y=0.0, z=0.0, w=1.0))


def _text(text: str, where: Point, z: float, size: float) -> TextPrimitive:
    return TextPrimitive(pose=_at(*where, z), billboard=True, font_size=size, color=_INK, text=text)


def _metadata(**values: object) -> list[KeyValuePair]:
    return [KeyValuePair(key=k, value=str(v)) for k, v in values.items() if v is not None]
