"""Places: online DBSCAN that equals batch DBSCAN after every keyframe.

The rules (Ester et al. 1996, 1998; DESIGN section 5):

1.  Two poses are neighbours within ε, inclusive; a pose is its own neighbour. A pose with at least
    ``min_samples`` neighbours is *core*. Core points that are neighbours are of one place.
2.  Points are only ever added, so a core point stays core and places only grow or merge.
3.  A newcomer can make itself core, and any of its neighbours. Everything that changes, changes
    around these *fresh* core points. Fresh ones that are neighbours act together: as one group when
    the newcomer is core (it is everybody's neighbour), else in groups that may be apart.
4.  A group that touches no older core point founds a place; its founder is its earliest keyframe.
    The place is named by the founder's run and a counter, and numbered in founding order.
5.  A group that touches one place extends it. One that touches several merges them: the one founded
    first survives, whatever the text of its id. A merge names one pair of core points for each
    absorbed place: a fresh one, and one of the place that it reached.
6.  A pose that is not core belongs to a place only by a core neighbour (*border*). It takes the
    place founded first among those in reach when it can first join one, and stays there, unless
    that place is absorbed. Without a core neighbour it is noise, which belongs to no place.

Rule 6 is the only freedom DBSCAN leaves; core points and their partition are unique.
"""

import math
from array import array
from collections.abc import Iterator

import numpy as np

from eventsrc.envelope import Offset, RunId
from projections.deltas import Delta, KeyframePlaced, Link, PlaceChanged, PlaceFormed, PlacesMerged
from projections.reducers import State, part, prefixed

from .core_index import Crowd
from .rule_index import RuledCrowd

NOISE = -1


class Places:
    """The reducer. Points are numbered by arrival among the keyframes that have a pose."""

    def __init__(self, crowd: Crowd | RuledCrowd) -> None:
        self.crowd = crowd
        self.joined = array("i")  # the place each point joined, as of then; NOISE for none
        self.keyframes = array("i")  # the ordinal of each point's keyframe
        self.runs = array("i")
        self.run_ids: dict[int, str] = {}
        self.founded: dict[int, int] = {}  # places founded so far, per run
        self.survivors: list[int] = []  # union-find over places by founding order
        self.member_counts: list[int] = []
        self.sums_x_um: list[int] = []
        self.sums_y_um: list[int] = []

    def fold(
        self,
        offset: Offset,
        keyframe: int,
        run: int,
        run_id: RunId,
        x_um: int,
        y_um: int,
        yaw: float,
    ) -> list[Delta]:
        """Take in a keyframe with a pose; what it changed, in the order of the delta contract."""
        point = len(self.joined)
        self.joined.append(NOISE)
        self.keyframes.append(keyframe)
        self.runs.append(run)
        self.run_ids[run] = run_id
        deltas: list[Delta] = []
        fresh = self.crowd.insert(x_um, y_um, yaw)
        if fresh == [point] and (settled := self.crowd.settled(point)) is not None:
            place = self.find(self.joined[settled])
            self._join(point, place)
            return [KeyframePlaced(offset, keyframe, place), self._changed(offset, place)]
        joining = self._grow(offset, point, fresh, deltas) if fresh else {}
        if point not in joining:
            place = self._earliest_in_reach(point)
            if place != NOISE:
                joining[point] = place
        changed = [d.survivor for d in deltas if type(d) is PlacesMerged]
        for joiner in sorted(joining):
            place = self.find(joining[joiner])
            self._join(joiner, place)
            changed.append(place)
            deltas.append(KeyframePlaced(offset, self.keyframes[joiner], place))
        deltas += [self._changed(offset, place) for place in sorted({*map(self.find, changed)})]
        return deltas

    def find(self, place: int) -> int:
        """The place that stands for ``place`` now."""
        survivors = self.survivors
        while survivors[place] != place:
            survivors[place] = survivors[survivors[place]]
            place = survivors[place]
        return place

    def label(self, point: int) -> int:
        """The point's current place, or NOISE."""
        joined = self.joined[point]
        return joined if joined == NOISE else self.find(joined)

    def dump(self) -> State:
        """Everything, for a snapshot."""
        own = {
            "joined": np.array(self.joined, np.int32),
            "keyframes": np.array(self.keyframes, np.int32),
            "runs": np.array(self.runs, np.int32),
            "run_ids": [[run, run_id] for run, run_id in self.run_ids.items()],
            "founded": [[run, count] for run, count in self.founded.items()],
            "survivors": self.survivors,
            "member_counts": self.member_counts,
            "sums_x_um": self.sums_x_um,
            "sums_y_um": self.sums_y_um,
        }
        return own | prefixed("crowd", self.crowd.dump())

    def load(self, state: State) -> None:
        """Take over what `dump` gave."""
        self.joined = array("i", state["joined"].tobytes())
        self.keyframes = array("i", state["keyframes"].tobytes())
        self.runs = array("i", state["runs"].tobytes())
        self.run_ids = dict(state["run_ids"])
        self.founded = dict(state["founded"])
        self.survivors = state["survivors"]
        self.member_counts = state["member_counts"]
        self.sums_x_um = state["sums_x_um"]
        self.sums_y_um = state["sums_y_um"]
        self.crowd.load(part("crowd", state))

    def _grow(
        self, offset: Offset, newcomer: int, fresh: list[int], deltas: list[Delta]
    ) -> dict[int, int]:
        """Found, extend and merge around the fresh core points; who joins which place by it."""
        joining: dict[int, int] = {}
        for group in self._groups(newcomer, fresh):
            touched = self._touched(group, fresh)
            if not touched:
                place = self._found(offset, group[0], deltas)
            else:
                place = min(touched)
                if len(touched) > 1:
                    deltas.append(self._merge(offset, newcomer, place, touched))
            for core in group:
                if self.joined[core] == NOISE:
                    joining[core] = place
                for loose in self.crowd.loose_around(core):
                    if self.joined[loose] == NOISE and loose != newcomer:
                        joining[loose] = min(place, self.find(joining.get(loose, place)))
        for core in fresh:  # so that the newcomer, if it is not core, sees them
            if self.joined[core] == NOISE:
                self.joined[core] = joining[core]
        return joining

    def _groups(self, newcomer: int, fresh: list[int]) -> Iterator[list[int]]:
        """The fresh core points in connected groups, each ascending, by their earliest."""
        if fresh[-1] == newcomer or len(fresh) == 1:
            yield fresh
            return
        rest = fresh
        while rest:
            group, frontier = [rest[0]], [rest[0]]
            rest = rest[1:]
            while frontier:
                core = frontier.pop()
                near = [other for other in rest if self.crowd.are_neighbours(core, other)]
                rest = [other for other in rest if other not in near]
                group += near
                frontier += near
            yield sorted(group)

    def _touched(self, group: list[int], fresh: list[int]) -> dict[int, tuple[int, int]]:
        """The places with an older core point near the group, each with one such pair."""
        touched: dict[int, tuple[int, int]] = {}
        crowd, joined = self.crowd, self.joined
        for core in group:
            own = NOISE
            for first, cell in crowd.cores_around(core):
                place = joined[first]
                if place == NOISE or first in fresh:
                    continue
                place = self.find(place)
                if cell is None:
                    own = place
                    touched.setdefault(place, (core, first))
                elif place == own:
                    crowd.unite(core, cell)  # type: ignore[arg-type]
                elif place not in touched:
                    neighbour = crowd.reach(cell, core)  # type: ignore[arg-type]
                    if neighbour is not None:  # a fresh one has the older ``first`` beside it
                        pair = (neighbour, first) if neighbour in fresh else (core, neighbour)
                        touched[place] = pair
        return touched

    def _earliest_in_reach(self, point: int) -> int:
        """Rule 6 for a newcomer that is not core."""
        best = NOISE
        for first, cell in self.crowd.cores_around(point):
            place = self.find(self.joined[first])
            if best not in (NOISE, place) and best < place:
                continue
            if cell is None or self.crowd.reach(cell, point) is not None:  # type: ignore[arg-type]
                best = place
        return best

    def _found(self, offset: Offset, founder: int, deltas: list[Delta]) -> int:
        place, run = len(self.survivors), self.runs[founder]
        counter = self.founded.get(run, 0)
        self.founded[run] = counter + 1
        self.survivors.append(place)
        self.member_counts.append(0)
        self.sums_x_um.append(0)
        self.sums_y_um.append(0)
        place_id = f"{self.run_ids[run]}_p{counter}"
        deltas.append(PlaceFormed(offset, place, place_id, self.keyframes[founder]))
        return place

    def _merge(
        self, offset: Offset, newcomer: int, survivor: int, touched: dict[int, tuple[int, int]]
    ) -> PlacesMerged:
        absorbed = tuple(sorted(place for place in touched if place != survivor))
        counts = self.member_counts
        delta = PlacesMerged(
            offset,
            survivor,
            absorbed,
            bridge=self.keyframes[newcomer],
            links=tuple(self._link(*touched[place]) for place in absorbed),
            survivor_count=counts[survivor],
            absorbed_counts=tuple(counts[place] for place in absorbed),
        )
        for place in absorbed:
            self.survivors[place] = survivor
            counts[survivor] += counts[place]
            self.sums_x_um[survivor] += self.sums_x_um[place]
            self.sums_y_um[survivor] += self.sums_y_um[place]
        return delta

    def _link(self, core: int, neighbour: int) -> Link:
        distance_um = math.isqrt(self.crowd.distance2(core, neighbour))
        return Link(self.keyframes[core], self.keyframes[neighbour], distance_um)

    def _join(self, point: int, place: int) -> None:
        self.joined[point] = place
        self.member_counts[place] += 1
        self.sums_x_um[place] += self.crowd.x[point]
        self.sums_y_um[place] += self.crowd.y[point]

    def _changed(self, offset: Offset, place: int) -> PlaceChanged:
        return PlaceChanged(
            offset,
            place,
            self.member_counts[place],
            self.sums_x_um[place],
            self.sums_y_um[place],
        )
