"""The graph of adjacent Places, in memory: shortest paths and neighbourhoods. Pure.

A building has hundreds of Places, not millions, so all of them are read at once and searched here;
a variable-length pattern in Cypher would load the whole graph per session instead.
"""

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from eventsrc.base.advised import advised
from projections.fold.errors import QuestionError
from projections.map.view import MapView


@dataclass(frozen=True, slots=True)
class PlaceNode:
    """A Place; ``ordinal`` is its founding order, the centroid is in metres. ``name`` is None where
    it has no name, ``type`` where it is not sure what kind of room it is."""

    ordinal: int
    place_id: str
    x: float
    y: float
    keyframe_count: int
    name: str | None = None
    type: str | None = None
    type_probability: float | None = None


class PlaceGraph:
    """Places by id, and undirected edges with their shared transitions."""

    def __init__(self, places: Iterable[PlaceNode], edges: Iterable[tuple[int, int, int]]) -> None:
        self.places: Mapping[int, PlaceNode] = {p.ordinal: p for p in places}
        self._ids = {p.place_id: p.ordinal for p in self.places.values()}
        self._next: dict[int, dict[int, int]] = {ordinal: {} for ordinal in self.places}
        for a, b, shared in edges:
            self._next[a][b] = self._next[b][a] = shared

    @classmethod
    def of_view(cls, view: MapView) -> "PlaceGraph":
        """The graph of a folded map."""
        nodes = []
        for p in view.places.values():
            node = PlaceNode(
                p.ordinal, p.place_id, p.centroid_x, p.centroid_y, p.keyframe_count, p.name
            )
            kind = view.type_of(p.ordinal)
            if kind is not None and kind.type is not None:
                node = replace(node, type=kind.type, type_probability=kind.probability)
            nodes.append(node)
        return cls(nodes, view.edges())

    def find(self, place_id: str) -> int:
        """The ordinal of a Place. Raises QuestionError if there is none of that id."""
        if place_id not in self._ids:
            raise QuestionError(
                f"no place {place_id!r} in this map; `{advised('state')}` lists them"
            )
        return self._ids[place_id]

    def hops_from(self, start: int, most: int) -> dict[int, int]:
        """Places within ``most`` steps of ``start`` (itself: 0), with their number of steps."""
        hops, waiting = {start: 0}, deque([start])
        while waiting:
            here = waiting.popleft()
            for neighbour in sorted(self._next[here]):
                if neighbour not in hops and hops[here] < most:
                    hops[neighbour] = hops[here] + 1
                    waiting.append(neighbour)
        return hops

    def path(self, start: int, goal: int) -> list[int] | None:
        """The path with the fewest steps, as ordinals; None if there is none.

        Of several, the one whose least driven step has the most transitions; then the one with the
        lowest ordinals.
        """
        steps = self.hops_from(goal, len(self.places))
        if start not in steps:
            return None
        # From the goal outwards, of each place: transitions of the least driven step, and path.
        best: dict[int, tuple[int, list[int]]] = {goal: (1 << 62, [goal])}
        for here in sorted(steps, key=lambda place: (steps[place], place)):
            if here == goal:
                continue
            ways = [
                (min(shared, best[n][0]), [here, *best[n][1]])
                for n, shared in self._next[here].items()
                if steps[n] == steps[here] - 1
            ]
            best[here] = min(ways, key=lambda way: (-way[0], way[1]))
        return best[start][1]

    def shared(self, a: int, b: int) -> int:
        """Shared transitions of two neighbours, 0 if they are none."""
        return self._next[a].get(b, 0)
