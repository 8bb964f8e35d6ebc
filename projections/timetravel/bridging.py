"""How one keyframe made two places one: the chain of core points that joins them.

Places merge when a path of core points, each within ε of the next, leads from one to the other. The
keyframe that came last need not be on that path: standing near a point, it may give it the last
neighbour that a core point needs. So the path leads from an old core point of the one place, over
points that this event made core, to an old core point of the other; the shortest one is told.

When an event joins several places, the chains make a tree: each further place hangs on one that is
joined already.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

from .history import History
from .lives import Merge


@dataclass(frozen=True, slots=True)
class Chain:
    """Core points from place ``joined`` to the absorbed place ``absorbed``, ends included.

    ``points`` are keyframe ordinals; all but the first and the last were made core by this event.
    ``distances_um`` are the steps between them.
    """

    joined: int
    absorbed: int
    points: tuple[int, ...]
    distances_um: tuple[int, ...]

    @property
    def made_core(self) -> tuple[int, ...]:
        """The points that this event made core."""
        return self.points[1:-1]


def chains_of(history: History, merge: Merge) -> list[Chain]:
    """A chain for each absorbed place, nearest to the survivor first.

    Empty when the merge was made by another rule than plain distance.
    """
    made = history.neighbours.made_core(merge.bridge, merge.cause.offset)
    doors = {keyframe: _doors(history, merge, keyframe) for keyframe in made}
    joined, waiting, chains = {merge.survivor}, set(merge.absorbed), list[Chain]()
    while waiting:
        chain = _shortest(history, merge, doors, joined, waiting)
        if chain is None:
            break
        chains.append(chain)
        joined.add(chain.absorbed)
        waiting.remove(chain.absorbed)
    return chains


def _doors(history: History, merge: Merge, keyframe: int) -> dict[int, int]:
    """By place the nearest old core point within ε of a new one."""
    offset, neighbours = merge.cause.offset, history.neighbours
    doors: dict[int, int] = {}
    near = (k for k in neighbours.of(keyframe, offset + 1) if neighbours.is_core(k, offset))
    for old in sorted(near, key=lambda k: (neighbours.distance_um(keyframe, k), k)):
        place = history.place_at(old, offset)
        if place is not None:
            doors.setdefault(place, old)
    return doors


def _shortest(
    history: History,
    merge: Merge,
    doors: dict[int, dict[int, int]],
    joined: set[int],
    waiting: set[int],
) -> Chain | None:
    """Breadth first over the new core points, from joined places to one that waits."""
    paths: deque[tuple[int, tuple[int, ...]]] = deque(
        (place, (old, new)) for new in doors for place, old in doors[new].items() if place in joined
    )
    seen = {path[-1] for _, path in paths}
    while paths:
        place, path = paths.popleft()
        for goal in sorted(doors[path[-1]].keys() & waiting):
            return _chain(history, place, goal, (*path, doors[path[-1]][goal]))
        for new in _next(history, merge, path[-1], doors):
            if new not in seen:
                seen.add(new)
                paths.append((place, (*path, new)))
    return None


def _next(
    history: History, merge: Merge, keyframe: int, doors: dict[int, dict[int, int]]
) -> Iterator[int]:
    near = history.neighbours.of(keyframe, merge.cause.offset + 1)
    return (k for k in near if k in doors)


def _chain(history: History, joined: int, absorbed: int, points: tuple[int, ...]) -> Chain:
    distances = tuple(history.neighbours.distance_um(a, b) for a, b in pairwise(points))
    return Chain(joined, absorbed, points, distances)
