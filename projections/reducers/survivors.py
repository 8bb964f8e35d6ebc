"""Which place lives on after merges: union-find with path halving."""

from collections.abc import Iterable

from projections.deltas import PlaceOrdinal


class PlaceSurvivors:
    """Absorbed places and their survivors; `merge` is called for every merge, in order.

    ``absorbed_by`` maps each absorbed place to one that took it over, which may have been absorbed
    itself; `find` shortens these chains.
    """

    __slots__ = ("absorbed_by",)

    def __init__(self) -> None:
        self.absorbed_by: dict[PlaceOrdinal, PlaceOrdinal] = {}

    def merge(self, survivor: PlaceOrdinal, absorbed: Iterable[PlaceOrdinal]) -> None:
        """``absorbed`` are parts of ``survivor`` from now on."""
        for place in absorbed:
            self.absorbed_by[place] = survivor

    def find(self, place: PlaceOrdinal) -> PlaceOrdinal:
        """The place that stands for ``place`` now; itself unless it was absorbed."""
        absorbed_by = self.absorbed_by
        while (parent := absorbed_by.get(place)) is not None:
            grandparent = absorbed_by.get(parent)
            if grandparent is None:
                return parent
            absorbed_by[place] = place = grandparent
        return place
