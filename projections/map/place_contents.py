"""Counts of Objects by place and class, updated with every change of an Object.

An Object counts for the place that it is located in, by its class; one that was observed once is
counted apart (`projections.fold.place_types.ONCE`). ``touched`` are the places whose counts have
changed since it was emptied last.
"""

from collections.abc import Mapping

from projections.fold.deltas import PlaceOrdinal
from projections.fold.place_types import ONCE

from .records import ObjectRecord


class PlaceContents:
    """Counts by place and class; `update` is to be called after every change of an Object."""

    def __init__(self) -> None:
        # place → class → Objects observed once, and more often
        self._counts: dict[PlaceOrdinal, dict[str, list[int]]] = {}
        self.touched: set[PlaceOrdinal] = set()

    def update(self, found: ObjectRecord) -> None:
        """Replace the Object's earlier count by its current one."""
        place = found.place
        now = None if place is None else (place, found.class_name, found.obs_count > 1)
        before = found.counted_as
        if now == before:
            return
        found.counted_as = now
        for key, change in ((before, -1), (now, 1)):
            if key is not None:
                in_place = self._counts.setdefault(key[0], {})
                in_place.setdefault(key[1], [0, 0])[key[2]] += change
                self.touched.add(key[0])

    def of(self, place: PlaceOrdinal) -> Mapping[str, float]:
        """The weight of each class in a place."""
        counts = self._counts.get(place, {})
        return {name: often + ONCE * once for name, (once, often) in counts.items()}
