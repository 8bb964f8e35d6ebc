"""Floors in re-localisation: poses one above the other are not near each other.

Where candidates are of several floors, positions on each are laid out beside those on the others,
`STEP_M` apart in x, before the ranking sees them; the pose of the answer is moved back and says
which floor it is on. A match that is of no Place is on a floor of its own. With one floor nothing
is moved. Only the floors of matches are laid out, since the databases return no others.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from projections.fold.deltas import PlaceOrdinal

from .camera import Floats
from .candidates import CandidatePlace, MapCandidates, Match, ObjectEstimate
from .ground import Flags, WallLookup, WallMap
from .pose import Posterior

STEP_M = 1e8


@dataclass(frozen=True, slots=True, eq=False)
class Hypotheses:
    """Poses (n, 3) in the map frame with weights (n,) that add up to 1, likeliest first, and the
    name of each one's floor."""

    poses: Floats
    weights: Floats
    floors: tuple[str | None, ...]


@dataclass(frozen=True, slots=True)
class _LaidOutWalls:
    """The walls of several floors, by their numbers."""

    floors: Mapping[int, WallMap]

    def contains(self, xy: Floats) -> Flags:
        """Which positions (h, 2) are inside walls."""
        found = np.zeros(len(xy), bool)
        number = np.round(xy[:, 0] / STEP_M)
        for each, walls in self.floors.items():
            here = number == each
            found[here] = walls.contains(xy[here] - (each * STEP_M, 0.0))
        return found

    def hides(self, things: Floats, xy: Floats, asked: Flags) -> Flags:
        """Whether a wall is between a thing (n, 2) and a position (h, 2): shape (n, h)."""
        hidden = np.zeros(asked.shape, bool)
        of_things, of_xy = (np.round(each[:, 0] / STEP_M) for each in (things, xy))
        for each, walls in self.floors.items():
            here = asked & (of_things == each)[:, None] & (of_xy == each)[None]
            moved = np.array((each * STEP_M, 0.0))
            hidden |= walls.hides(things - moved, xy - moved, here)
        return hidden


@dataclass(frozen=True, slots=True)
class Layout:
    """``numbers`` are those of the floors with Places, by name; None has none."""

    numbers: Mapping[str | None, int]

    @classmethod
    def of(cls, candidates: MapCandidates) -> "Layout":
        """The floors of these matches: named ones in the order of their names, then the unnamed
        one."""
        ordinals = {
            place
            for row in candidates.matches
            for match in row
            for place in (match.object_place, match.keyframe_place)
            if place is not None
        }
        names = {candidates.places[place].floor for place in ordinals}
        ordered: list[str | None] = [*sorted(name for name in names if name is not None)]
        return cls({name: i for i, name in enumerate(ordered + [None] * (None in names))})

    @property
    def has_several(self) -> bool:
        """Whether there are several floors, so that positions are moved."""
        return len(self.numbers) > 1

    def laid_out(self, candidates: MapCandidates) -> MapCandidates:
        """The candidates with their positions laid out."""
        if not self.has_several:
            return candidates
        rows = candidates.matches
        moved = tuple(tuple(self._moved(m, candidates.places) for m in row) for row in rows)
        return replace(candidates, matches=moved)

    def walls(self, walls: Mapping[str | None, WallMap]) -> WallLookup | None:
        """The walls of each floor, laid out; None where there are none."""
        if not self.numbers:  # no match is in a Place, so all may be on any floor
            return next(iter(walls.values())) if len(walls) == 1 else None
        found = {number: walls[name] for name, number in self.numbers.items() if name in walls}
        if self.has_several:
            return _LaidOutWalls(found) if found else None
        return found.get(0)

    def floor_at(self, x: float) -> str | None:
        """The floor of a laid out position; None where it has no name."""
        number = round(x / STEP_M) if self.has_several else 0
        return next((name for name, each in self.numbers.items() if each == number), None)

    def put_back(self, x: float) -> float:
        """A laid out x as it is on its floor."""
        return x - round(x / STEP_M) * STEP_M if self.has_several else x

    def spread_m(self, posterior: Posterior) -> float:
        """The root mean square distance of the poses on the answer's floor from it."""
        if not self.has_several:
            return posterior.spread_m
        dx, dy = posterior.poses[:, 0] - posterior.x, posterior.poses[:, 1] - posterior.y
        weights = posterior.weights * (np.abs(dx) < STEP_M / 2)
        return math.sqrt(float(weights @ (dx * dx + dy * dy)) / float(weights.sum()))

    def hypotheses(self, posterior: Posterior) -> Hypotheses:
        """The poses of a posterior, moved back to their floors."""
        if not self.has_several:
            floor = next(iter(self.numbers), None)
            return Hypotheses(posterior.poses, posterior.weights, (floor,) * len(posterior.poses))
        poses = posterior.poses.copy()
        floors = tuple(self.floor_at(x) for x in poses[:, 0].tolist())
        poses[:, 0] -= np.round(poses[:, 0] / STEP_M) * STEP_M
        return Hypotheses(poses, posterior.weights, floors)

    def _moved(self, match: Match, places: Mapping[PlaceOrdinal, CandidatePlace]) -> Match:
        place = match.object_place if match.keyframe_place is None else match.keyframe_place
        number = len(self.numbers) if place is None else self.numbers[places[place].floor]
        if not number:
            return match
        dx, pose, estimate = number * STEP_M, match.pose, match.object_estimate
        return match._replace(
            pose=None if pose is None else (pose[0] + dx, pose[1], pose[2]),
            object_estimate=None if estimate is None else _moved_estimate(estimate, dx),
        )


def _moved_estimate(estimate: ObjectEstimate, dx: float) -> ObjectEstimate:
    return replace(estimate, x=estimate.x + dx)
