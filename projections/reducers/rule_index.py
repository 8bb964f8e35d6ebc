"""Core-point index when neighbourhood is another rule than plain distance.

Any symmetric predicate on two poses defines density-connected sets (GDBSCAN: Sander, Ester, Kriegel
and Xu 1998). Without the triangle inequality a cell says nothing about which points are core, so
the predicate is evaluated for every pose within its reach: the cost of a keyframe grows with how
many poses lie around it, though not with the length of the log. Same interface as `CoreIndex`.
"""

from array import array
from collections.abc import Iterator

import numpy as np

from projections.deltas import Pose
from projections.errors import SettingsError
from projections.exact import Neighbourhood
from projections.reducers import State
from projections.settings import Settings


class RuleCoreIndex:
    """Points and which of them are core, by a `Neighbourhood`."""

    def __init__(self, rule: Neighbourhood, min_samples: int) -> None:
        self._rule = rule
        self._side = rule.reach_um + 1
        self._min_samples = min_samples
        self.x = array("q")
        self.y = array("q")
        self._poses: list[Pose] = []
        self._counts = array("i")
        self._cells: dict[tuple[int, int], list[int]] = {}

    def insert(self, x_um: int, y_um: int, yaw_rad: float) -> list[int]:
        """Add a point; the indices of the points that became core by it, ascending."""
        point = len(self._poses)
        self.x.append(x_um)
        self.y.append(y_um)
        self._poses.append(Pose(x_um, y_um, yaw_rad))
        self._counts.append(1)
        neighbours = list(self._neighbours(point))
        self._counts[point] += len(neighbours)
        self._cells.setdefault((x_um // self._side, y_um // self._side), []).append(point)
        fresh = [] if self._counts[point] < self._min_samples else [point]
        for other in neighbours:
            self._counts[other] += 1
            if self._counts[other] == self._min_samples:
                fresh.append(other)
        return sorted(fresh)

    def is_core(self, point: int) -> bool:
        """True when the point has at least ``min_samples`` neighbours."""
        return self._counts[point] >= self._min_samples

    def enclosing_core(self, point: int) -> None:  # noqa: ARG002
        """Never known under a rule; see `CoreIndex.enclosing_core`."""
        return

    def enclosing_core_beside(self, point: int, settled: object) -> None:  # noqa: ARG002
        """Never known under a rule; see `CoreIndex.enclosing_core_beside`."""
        return

    def squared_distance(self, a: int, b: int) -> int:
        """The squared distance of two points, in µm²."""
        return (self.x[a] - self.x[b]) ** 2 + (self.y[a] - self.y[b]) ** 2

    def are_neighbours(self, a: int, b: int) -> bool:
        """True when the two are within the rule's reach and it holds for them."""
        reach_um = self._rule.reach_um
        return (
            abs(self.x[a] - self.x[b]) <= reach_um
            and abs(self.y[a] - self.y[b]) <= reach_um
            and self._rule.holds(self._poses[a], self._poses[b])
        )

    def first_core(self, core: int) -> int:
        """The core point itself: under a rule, a cell is no cluster."""
        return core

    def put_first(self, core: int) -> None:
        """Does nothing; see `first_core`."""

    def cores_around(self, point: int) -> Iterator[tuple[int, None]]:
        """Each core point among the point's neighbours; see `CoreIndex.cores_around`."""
        return ((other, None) for other in self._neighbours(point) if self.is_core(other))

    def core_in_reach(self, cell: object, point: int) -> int | None:
        """Never called: `cores_around` gives neighbours only."""
        raise NotImplementedError

    def mark_one_cluster(self, point: int, cell: object) -> None:
        """Does nothing: under a rule, a cell is no cluster."""

    def non_core_around(self, point: int) -> Iterator[int]:
        """The point's neighbours that are not core."""
        return (other for other in self._neighbours(point) if not self.is_core(other))

    def dump(self) -> State:
        """Everything, for a snapshot."""
        return {
            "x": np.array(self.x, np.int64),
            "y": np.array(self.y, np.int64),
            "yaw": np.array([pose.yaw_rad for pose in self._poses]),
            "counts": np.array(self._counts, np.int32),
        }

    def load(self, state: State) -> None:
        """Take over what `dump` gave."""
        self.x = array("q", state["x"].tobytes())
        self.y = array("q", state["y"].tobytes())
        self._counts = array("i", state["counts"].tobytes())
        self._poses = list(map(Pose, self.x, self.y, state["yaw"].tolist()))
        for point, pose in enumerate(self._poses):
            key = pose.x_um // self._side, pose.y_um // self._side
            self._cells.setdefault(key, []).append(point)

    def _neighbours(self, point: int) -> Iterator[int]:
        column, row = self.x[point] // self._side, self.y[point] // self._side
        for dx in (-1, 0, 1):
            for dy in (-1, 0, 1):
                for other in self._cells.get((column + dx, row + dy), ()):
                    if other != point and self.are_neighbours(point, other):
                        yield other


def check_named(settings: Settings, neighbourhood: Neighbourhood | None) -> None:
    """Raise SettingsError unless the rule is the one that the settings name."""
    given = None if neighbourhood is None else neighbourhood.name
    if given != settings.neighbourhood:
        raise SettingsError(
            f"the settings name the neighbourhood {settings.neighbourhood!r}, the fold was given "
            f"{given!r}; write SemanticMap(Settings(neighbourhood=rule.name), rule), "
            "or neither for plain distance"
        )
