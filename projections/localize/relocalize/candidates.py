"""Candidates: the map's observations most similar to each crop, and their Places.

`MapCandidates` is the whole input of the ranking. The databases make it with one query
(`projections.postgres.queries.candidate_search`), a folded map by exact search (`ExactIndex`). The
ranking treats both alike.

Exact search: unit vectors are multiples of 2⁻²⁰ and multiplied in float64, so every sum is exact
whatever BLAS does (see `projections.fold.exact`). The same map and crops give the same candidates
to the last bit.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eventsrc.base.text import counted
from eventsrc.envelope.model import RunId
from projections.fold.deltas import ObservationOrdinal, PlaceOrdinal
from projections.fold.exact import Q40, quantise
from projections.fold.map_errors import QuestionError
from projections.map.records import EstimatedPosition
from projections.map.view import MapView

from .camera import CameraValues, camera_values
from .constants import FOLLOWERS, Cosines, MapConstants, Sample
from .ground import WallMap
from .question import Box, QuestionCrop, Vector, describe_value

NEIGHBOURS = 64
"""Observations fetched per crop. From 48 on, the measures in docs/relocalization.md stay the same;
fewer leave too few directions to triangulate an object from."""

OBJECTS_OF_A_CLASS = 96
"""The most Objects fetched for a crop of which only the class is known: those seen most often."""
MOST_OBJECTS = 128
"""The most Objects fetched for all classes of such crops, since each takes a third of a
millisecond."""
OBSERVATIONS_OF_EACH = 3
"""Observations fetched of each such Object, spread evenly over all of its observations."""

Pose = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class ObjectEstimate:
    """The estimated position of an Object under fusion by evidence, in metres, with its covariance
    in m²; the Object was seen from ``spots`` positions of robots."""

    x: float
    y: float
    xx: float
    xy: float
    yy: float
    spots: int


class Match(NamedTuple):
    """An observation in the map that looks like a crop; ``run_id`` is the run that made it.

    ``pose`` is that of its keyframe in metres and radians, None if the robot had none.
    ``object_place`` is where its Object is located and ``keyframe_place`` where the robot was:
    ordinals of Places, None for noise. ``class_name`` is the Object's if there is one.
    ``object_estimate`` is the estimated position of the Object, None under the default fusion.
    ``camera`` is that of the keyframe, None where its envelope does not state one.

    A tuple, because a question makes hundreds, each of which would take 4 µs as a frozen dataclass.
    """

    observation: ObservationOrdinal
    det_id: str
    run_id: RunId
    similarity: float
    pose: Pose | None
    bbox: Box | None
    class_name: str
    object_id: str | None = None
    object_place: PlaceOrdinal | None = None
    keyframe_place: PlaceOrdinal | None = None
    object_estimate: ObjectEstimate | None = None
    camera: CameraValues | None = None


@dataclass(frozen=True, slots=True)
class CandidatePlace:
    """A Place that a match belongs to: id, centroid in metres, name if it has one, and the floor it
    is on if the log names that."""

    place_id: str
    x: float
    y: float
    name: str | None = None
    floor: str | None = None


@dataclass(frozen=True, slots=True)
class MapCandidates:
    """``matches[i]`` are those of crop i, most similar first, ties by ordinal.

    Those of a crop without an embedding are observations of Objects of its class, with the
    similarity 1. ``by_class`` is whether the map has no embedding, so that crops with one were
    matched by their classes. ``walls`` are those of the occupancy maps in force, by floor.
    """

    matches: tuple[tuple[Match, ...], ...]
    places: Mapping[PlaceOrdinal, CandidatePlace]
    constants: MapConstants = field(default_factory=MapConstants)
    walls: Mapping[str | None, WallMap] = field(default_factory=dict)
    by_class: bool = False


_MULTIPLIED = 2**19
"""The most numbers that are multiplied at once: a block stays in a core's cache, and no BLAS starts
threads for so few."""
_FEWEST_CROPS = 4


class ExactIndex:
    """An index for exact search: the observations of a view that have an embedding, as one
    matrix."""

    def __init__(self, view: MapView) -> None:
        self._view = view
        self._ordinals = view.embedded()
        self.places = {
            place.ordinal: CandidatePlace(
                place.place_id,
                place.centroid_x,
                place.centroid_y,
                place.name,
                view.floor_of(place.ordinal),
            )
            for place in view.places.values()
        }
        first = self._ordinals[:1]
        self.model = view.observations[int(first[0])].embedding_model if len(first) else None
        self._dimension = view.vectors(first).shape[1] if len(first) else 0
        self.constants = MapConstants.of(view.settings, self._different())
        maps = view.maps_in_force()
        self._walls = {floor: WallMap(given.map) for floor, given in maps.items()}

    @cached_property
    def _matrix(self) -> NDArray[np.int32]:
        """The vectors of all observations that have one; questions by class alone need none."""
        return self._view.vectors(self._ordinals)

    def _different(self) -> Cosines:
        """The statistics of cosines between different things in one picture, over a sample."""
        ordinals = self._ordinals
        sample = Sample.of(int(ordinals[-1]) + 1 if len(ordinals) else 0)
        rows = np.flatnonzero((ordinals < sample.limit) & ((ordinals + 1) % sample.stride == 0))
        pairs = []
        for row in rows.tolist():
            one = self._view.observations[int(ordinals[row])]
            for other in range(row + 1, min(row + 1 + FOLLOWERS, len(ordinals))):
                second = self._view.observations[int(ordinals[other])]
                if (
                    second.keyframe == one.keyframe
                    and second.ordinal <= one.ordinal + FOLLOWERS
                    and second.class_name != one.class_name
                ):
                    pairs.append((row, other))
        if not pairs:
            return Cosines()
        used, at = np.unique(np.array(pairs), return_inverse=True)
        vectors = self._view.vectors(ordinals[used]).astype(np.float64)
        products = [
            float(vectors[one] @ vectors[other]) / Q40 for one, other in at.reshape(-1, 2).tolist()
        ]
        return Cosines(len(products), float(np.mean(products)), float(np.std(products)))

    def check_spaces(self, crops: Sequence[QuestionCrop]) -> None:
        """Raise QuestionError when a crop is not of the map's embedding space."""
        if len(self._ordinals):
            for crop in crops:
                check_space(crop, self._dimension, self.model)

    def search(
        self,
        crops: Sequence[QuestionCrop],
        neighbours: int = NEIGHBOURS,
        without: Collection[ObservationOrdinal] = (),
    ) -> MapCandidates:
        """The nearest observations of each crop, as if the map had none of those ``without``.
        Raises QuestionError for another space."""
        self.check_spaces(crops)
        if labels := self._view.corrections.labels:
            crops = [crop.called(labels) for crop in crops]
        given = crops
        if not len(self._ordinals):
            crops = [crop.by_class() for crop in crops]
        dropped = np.isin(self._ordinals, list(without)) if without else None
        objects = objects_of_a_class(crops)
        products = iter(self._products([c.vector for c in crops if c.vector is not None]))
        matches = tuple(
            self._of_class(crop.class_name, objects, without)
            if crop.vector is None
            else self._nearest(next(products), neighbours, dropped)
            for crop in crops
        )
        refuse_unknown_classes(given, matches, self._class_names)
        by_class = not len(self._ordinals) and any(matches)
        return MapCandidates(matches, self.places, self.constants, self._walls, by_class)

    def _products(self, vectors: Sequence[Vector]) -> NDArray[np.float64]:
        """The products of each vector and each observation, in units of 2⁻⁴⁰."""
        found = np.empty((len(vectors), len(self._ordinals)))
        if vectors:
            asked = np.array([quantise(vector) for vector in vectors]).astype(np.float64)
            rows = max(1, _MULTIPLIED // (asked.shape[1] * max(len(vectors), _FEWEST_CROPS)))
            for first in range(0, len(self._ordinals), rows):
                block = self._matrix[first : first + rows].astype(np.float64)
                found[:, first : first + rows] = asked @ block.T
        return found

    def _nearest(
        self, products: NDArray[np.float64], neighbours: int, dropped: NDArray[np.bool_] | None
    ) -> tuple[Match, ...]:
        if dropped is not None:
            products[dropped] = -np.inf
            neighbours = min(neighbours, len(dropped) - int(dropped.sum()))
        order = np.argsort(-products, kind="stable")[:neighbours]
        # Rounded vectors may be a little longer than 1, so that a cosine would be above 1.
        return tuple(
            self._match(
                ObservationOrdinal(int(self._ordinals[i])), min(float(products[i]) / Q40, 1.0)
            )
            for i in order
        )

    def _of_class(
        self, class_name: str | None, objects: int, without: Collection[ObservationOrdinal]
    ) -> tuple[Match, ...]:
        things = [o for o in self._view.objects.values() if o.class_name == class_name]
        most = sorted(things, key=lambda o: (-o.obs_count, o.ordinal))[:objects]
        picked = [
            seen[position]
            for seen in (sorted(set(thing.observations).difference(without)) for thing in most)
            for position in range(len(seen))
            if (position + 1) * OBSERVATIONS_OF_EACH // len(seen)
            > position * OBSERVATIONS_OF_EACH // len(seen)
        ]
        return tuple(self._match(ordinal, 1.0) for ordinal in sorted(picked))

    def _class_names(self) -> set[str]:
        return {found.class_name for found in self._view.objects.values()}

    def _match(self, ordinal: ObservationOrdinal, similarity: float) -> Match:
        observation = self._view.observations[ordinal]
        keyframe = self._view.keyframes[observation.keyframe]
        found = None if observation.object is None else self._view.objects[observation.object]
        pose, camera = keyframe.pose, keyframe.camera
        return Match(
            ordinal,
            observation.det_id,
            keyframe.run_id,
            similarity,
            None if pose is None else (pose.x_um / 1e6, pose.y_um / 1e6, pose.yaw_rad),
            observation.bbox,
            observation.class_name if found is None else found.class_name,
            None if found is None else found.object_id,
            None if found is None else found.place,
            keyframe.place,
            None if found is None else _in_metres(found.estimate),
            None if camera is None else camera_values(camera),
        )


def _in_metres(estimate: EstimatedPosition | None) -> ObjectEstimate | None:
    if estimate is None:
        return None
    return ObjectEstimate(
        estimate.est_x,
        estimate.est_y,
        *estimate.covariance_m2,
        estimate.spots,
    )


def objects_of_a_class(crops: Sequence[QuestionCrop]) -> int:
    """The number of Objects to fetch for each crop of which only the class is known."""
    classes = {crop.class_name for crop in crops if crop.vector is None}
    return min(OBJECTS_OF_A_CLASS, MOST_OBJECTS // max(len(classes), 1))


def refuse_unknown_classes(
    crops: Sequence[QuestionCrop],
    matches: Sequence[Sequence[Match]],
    class_names: Callable[[], Iterable[str]],
) -> None:
    """Raise QuestionError for a class that the map does not have, where nothing but classes is
    asked with: for one that was typed, as it has no box, and if no crop of a detector has any
    match. ``class_names`` gives the classes of all Objects."""
    if any(crop.vector is not None for crop in crops):
        return
    some = any(matches)
    for crop, row in zip(crops, matches, strict=True):
        if not row and (crop.bbox is None or not some):
            names = sorted(class_names())
            near = get_close_matches(crop.class_name or "", names, 3, 0.5)
            there = (
                f"similar ones: {', '.join(near)}"
                if near
                else f"there are {', '.join(names[:_SHOWN])}{', …' if len(names) > _SHOWN else ''}"
                if names
                else "it has none"
            )
            raise QuestionError(
                f"the map has no object of class {describe_value(crop.class_name)}; {there}"
            )


_SHOWN = 12


def check_space(crop: QuestionCrop, dimension: int, model: str | None) -> None:
    """Raise QuestionError when the crop is not of the map's embedding space."""
    if crop.vector is None:
        return
    if len(crop.vector) != dimension:
        raise QuestionError(
            f"the question's embeddings have {counted(len(crop.vector), 'dimension')}, the"
            f" map's {dimension}; ask with the model that made the map ({model})"
        )
    if crop.model is not None and model is not None and crop.model != model:
        raise QuestionError(
            f"the question's embeddings are of model {crop.model!r}, the map's of {model!r};"
            " ask with the model that made the map"
        )
