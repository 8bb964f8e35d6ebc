"""In which room a position is, by every keyframe whose room is known: a floor plan of sorts.

The map's own keyframes cannot name a room the map never entered, though a pose may well lie in it.
So the whole of the map's log counts, also what comes after ``--at``, and the query runs that saw a
thing the map's log saw too; another building's runs, in a frame of their own, do not.
"""

from collections.abc import Sequence

import numpy as np

from eventsrc.ingest import Accepted

from .truth import Key, Truth


class FloorPlan:
    """Nearest keyframe of known room, leaving out the one that asks."""

    def __init__(
        self, mapped: Sequence[Accepted], asking: Sequence[Accepted], truth: Truth
    ) -> None:
        at_home = _instances(mapped, truth)
        runs = {_key(k)[0] for k in asking if at_home & _instances([k], truth)}
        here = [*mapped, *(k for k in asking if _key(k)[0] in runs)]
        known = {key: k for k in here if truth.room(key := _key(k)) is not None}
        self._keys = list(known)
        self._rooms = [truth.room(key) for key in self._keys]
        poses = [(k.envelope.map_x or 0.0, k.envelope.map_y or 0.0) for k in known.values()]
        self._at = np.array(poses, dtype=np.float64).reshape(-1, 2)

    def room(self, x: float, y: float, asking: Key) -> str | None:
        """The room at a position in metres; None when no other keyframe's room is known."""
        squared = ((self._at - (x, y)) ** 2).sum(1)
        nearest = np.argsort(squared, kind="stable")[:2]
        return next((self._rooms[i] for i in nearest if self._keys[i] != asking), None)


def _key(keyframe: Accepted) -> Key:
    return keyframe.envelope.run_id, keyframe.envelope.keyframe_id


def _instances(keyframes: Sequence[Accepted], truth: Truth) -> set[str]:
    found = (truth.keyframes.get(_key(k)) for k in keyframes)
    return {i for line in found if line is not None for i in line.instances if i is not None}
