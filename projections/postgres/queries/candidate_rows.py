"""What questions for candidates get from the databases: a map's constants, and candidates.

A question carries the keys of cached values; the databases send cosines and settings only if their
keys differ. So constants cost no round trip, and little time after the first question. If the key
of the occupancy maps differs, they are read by a further statement.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, NamedTuple, Self, TypeAlias

from pydantic import ValidationError

from eventsrc.base.text import advised
from eventsrc.envelope.model import StatedCamera
from eventsrc.envelope.occupancy_map import OccupancyMap
from projections.fold.deltas import ObservationOrdinal, PlaceOrdinal
from projections.fold.map_errors import (
    ProjectionMismatch,
)
from projections.fold.settings import Settings
from projections.localize.relocalize import (
    CandidatePlace,
    MapCandidates,
    MapConstants,
    Match,
    ObjectEstimate,
    WallMap,
)
from projections.localize.relocalize.camera import camera_values
from projections.localize.relocalize.constants import FOLLOWERS, SAMPLED, Cosines
from projections.localize.relocalize.question import Box
from projections.postgres.labels import number_of


@dataclass(frozen=True, slots=True)
class KnownConstants:
    """Constants, and the keys of the database values that they were computed from."""

    cosines_key: str | None = None
    cosines: Cosines = field(default_factory=Cosines)
    settings_key: str | None = None
    settings: Settings = field(default_factory=Settings)
    constants: MapConstants = field(default_factory=MapConstants)
    maps_key: str | None = None
    walls: Mapping[str | None, WallMap] = field(default_factory=dict)

    @property
    def parameters(self) -> dict[str, Any]:
        """The parameters of the statements."""
        return {
            "known_cosines": self.cosines_key,
            "known_settings": self.settings_key,
            "known_maps": self.maps_key,
            "sampled": SAMPLED,
            "followers": FOLLOWERS,
        }

    def with_cosines(self, sent: list[Any] | None) -> Self:
        """The constants after the databases have sent ``[key, number, mean, deviation]``, or
        nothing."""
        if sent is None:
            return self
        cosines = Cosines(*sent[1:])
        constants = MapConstants.of(self.settings, cosines)
        return replace(self, cosines_key=sent[0], cosines=cosines, constants=constants)

    def with_settings(self, sent: list[str] | None, place: str) -> Self:
        """The constants after the databases have sent ``[fingerprint, settings]``, or nothing.

        ``place`` is the database, for an error.
        """
        if sent is None:
            return self
        try:
            settings = Settings.model_validate_json(sent[1])
        except ValidationError:
            raise ProjectionMismatch(
                f"{place}: the map there has settings that this version of mapfold does not know;"
                f" run `{advised('replay')}`"
            ) from None
        constants = MapConstants.of(settings, self.cosines)
        return replace(self, settings_key=sent[0], settings=settings, constants=constants)

    def with_maps(self, key: str | None, maps: Mapping[str | None, OccupancyMap]) -> Self:
        """The constants after the maps of a key were read."""
        walls = {floor: WallMap(given) for floor, given in maps.items()}
        return replace(self, maps_key=key, walls=walls)


NOTHING_KNOWN: Final = KnownConstants()


class ConstantsMemory:
    """The constants and walls after the last question; for any thread, as they are replaced as a
    whole."""

    def __init__(self) -> None:
        self.known = NOTHING_KNOWN


Rows: TypeAlias = list[tuple[Any, ...]]


class _Thing(NamedTuple):
    object_id: str
    class_name: str
    estimate: ObjectEstimate | None


_NONE: Final = 0
"""Stands for no graph id; ids are never 0."""
_NO_EDGES: Final = (_NONE, _NONE, _NONE)


class Linked(NamedTuple):
    """Ids of Object, its Place and the keyframe's Place by det_pk; and the Objects and Places with
    these ids."""

    ids: dict[int, tuple[int, int, int]]
    things: dict[int, _Thing]
    places: dict[int, tuple[PlaceOrdinal, CandidatePlace]]

    @classmethod
    def of(cls, edges: Sequence[list[int]], things: dict[str, str], places: dict[str, str]) -> Self:
        """Made from the edges in the statement ``graph`` and the properties of Objects and
        Places."""
        observes, located, has, in_place = (
            dict(zip(starts, ends, strict=True))
            for starts, ends in zip(edges[::2], edges[1::2], strict=True)
        )
        ids = {
            number_of(observation): (
                thing := observes.get(observation, _NONE),
                located.get(thing, _NONE),
                in_place.get(has.get(observation, _NONE), _NONE),
            )
            for observation in observes.keys() | has.keys()
        }
        return cls(
            ids,
            {int(thing): _thing(properties) for thing, properties in things.items()},
            {
                int(place): (PlaceOrdinal(number_of(int(place)) - 1), _place(properties))
                for place, properties in places.items()
            },
        )

    def union(self, more: "Linked") -> "Linked":
        """The union with ``more``."""
        return Linked(self.ids | more.ids, self.things | more.things, self.places | more.places)


NO_LINKS: Final = Linked({}, {}, {})


def assemble(crops: int, near: Rows, linked: Linked, known: KnownConstants) -> MapCandidates:
    """The candidates of ``near``: rows of crop, similarity, det_pk and further columns."""
    ordered = sorted(near, key=lambda row: (row[0], -row[1], row[2]))
    matches: list[list[Match]] = [[] for _ in range(crops)]
    ordinals = {place: ordinal for place, (ordinal, _) in linked.places.items()}
    for crop, similarity, det_pk, det_id, run_id, class_name, bbox, x, y, yaw, camera, _ in ordered:
        thing_id, its, there = linked.ids.get(det_pk, _NO_EDGES)
        thing = linked.things.get(thing_id)
        matches[crop].append(
            Match(
                ObservationOrdinal(det_pk - 1),
                det_id,
                run_id,
                float(similarity),
                None if x is None else (x, y, yaw),
                _box(bbox),
                class_name if thing is None else thing.class_name,
                None if thing is None else thing.object_id,
                ordinals.get(its),
                ordinals.get(there),
                None if thing is None else thing.estimate,
                None if camera is None else tuple(camera),
            )
        )
    rows = tuple(map(tuple, matches))
    return MapCandidates(rows, dict(linked.places.values()), known.constants, known.walls)


def bare_row(det_pk: int, observation: str, pose: str, keyframe: str) -> tuple[Any, ...]:
    """The columns of the statement ``described`` from ``similarity`` on, made of the properties of
    an observation's node and of its keyframe's Pose and Keyframe."""
    seen, at, camera = json.loads(observation), json.loads(pose), json.loads(keyframe).get("camera")
    stated = None if camera is None else camera_values(StatedCamera(**camera))
    named = (seen["det_id"], seen["run_id"], seen["class_name"], f"{{{str(seen['bbox'])[1:-1]}}}")
    return 1.0, det_pk, *named, at["map_x"], at["map_y"], at["map_yaw"], stated, None


def _box(array: str) -> Box:
    """A box from the text form of its array, which gives the log's numbers; the binary form would
    be rounded to 32 bits."""
    x0, y0, x1, y1 = array[1:-1].split(",")
    return float(x0), float(y0), float(x1), float(y1)


def _thing(properties: str) -> _Thing:
    """An Object; without an estimate under ``fusion = "page"``."""
    found = json.loads(properties)
    estimate = None
    if "est_xx" in found:
        estimate = ObjectEstimate(
            *(found[f"est_{name}"] for name in ("x", "y", "xx", "xy", "yy", "spots"))
        )
    return _Thing(found["object_id"], found["class_name"], estimate)


def _place(properties: str) -> CandidatePlace:
    found = json.loads(properties)
    return CandidatePlace(
        found["place_id"],
        found["centroid_x"],
        found["centroid_y"],
        found.get("name"),
        found.get("floor"),
    )
