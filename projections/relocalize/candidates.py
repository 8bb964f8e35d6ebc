"""What a search brings back for each crop: the map's observations most like it, and their places.

This is the whole input of the ranking. The databases make it with one query, a folded state by
exact search (`projections.relocalize.exact_search`); which of the two it was makes no difference.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from .question import Box

NEIGHBOURS = 64
"""Observations fetched per crop. From 48 on, the measures in docs/relocalization.md stay the same;
fewer leave too few directions to triangulate an object from."""

Pose = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Match:
    """An observation in the map that looks like a crop; ``run_id`` is the run that made it.

    ``pose`` is that of its keyframe in metres and radians, None if the robot had none.
    ``object_place`` is where its Object is located and ``keyframe_place`` where the robot was:
    ordinals of Places, None for noise. ``class_name`` is the Object's if there is one.
    """

    observation: int
    det_id: str
    run_id: str
    similarity: float
    pose: Pose | None
    bbox: Box | None
    class_name: str
    object_id: str | None = None
    object_place: int | None = None
    keyframe_place: int | None = None


@dataclass(frozen=True, slots=True)
class Spot:
    """A Place: id and centroid in metres."""

    place_id: str
    x: float
    y: float


@dataclass(frozen=True, slots=True)
class Candidates:
    """``matches[i]`` are those of crop i, most similar first, ties by ordinal."""

    matches: tuple[tuple[Match, ...], ...]
    places: Mapping[int, Spot]
