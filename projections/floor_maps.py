"""Which occupancy map is in force on a floor."""

from collections.abc import Mapping

from projections.deltas import MapGiven


def map_in_force(
    given: Mapping[str | None, MapGiven], floor: str | None, *, is_first: bool
) -> MapGiven | None:
    """The map on ``floor``, of those ``given`` by the floor that they name. One that names none is
    of the floor that the log is of first, unless another names that one."""
    named = None if floor is None else given.get(floor)
    return given.get(None) if named is None and is_first else named
