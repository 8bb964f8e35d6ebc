"""A map's constants and walls read from the databases, cached between questions.

A question carries the keys of cached values; the databases send cosines and settings only if their
keys differ. So constants cost no round trip, and little time after the first question. If the key
of the occupancy maps differs, they are read by a further statement.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final, Self

from pydantic import ValidationError

from eventsrc.base.advised import advised
from eventsrc.envelope.occupancy_map import OccupancyMap
from projections.fold.errors import ProjectionMismatch
from projections.fold.settings import Settings
from projections.localize.relocalize import MapConstants, WallMap
from projections.localize.relocalize.constants import FOLLOWERS, SAMPLED, Cosines


@dataclass(frozen=True, slots=True)
class KnownConstants:
    """Constants, and the keys of the database values that they were computed from."""

    cosines_key: str | None = None
    cosines: Cosines = field(default_factory=Cosines)
    settings_key: str | None = None
    settings: Settings = field(default_factory=Settings)
    constants: MapConstants = field(default_factory=MapConstants)
    maps_key: str | None = None
    walls: Mapping[str | None, WallMap] = field(default_factory=dict)

    @property
    def parameters(self) -> dict[str, Any]:
        """The parameters of the statements."""
        return {
            "known_cosines": self.cosines_key,
            "known_settings": self.settings_key,
            "known_maps": self.maps_key,
            "sampled": SAMPLED,
            "followers": FOLLOWERS,
        }

    def with_cosines(self, sent: list[Any] | None) -> Self:
        """The constants after the databases have sent ``[key, number, mean, deviation]``, or
        nothing."""
        if sent is None:
            return self
        cosines = Cosines(*sent[1:])
        constants = MapConstants.of(self.settings, cosines)
        return replace(self, cosines_key=sent[0], cosines=cosines, constants=constants)

    def with_settings(self, sent: list[str] | None, place: str) -> Self:
        """The constants after the databases have sent ``[fingerprint, settings]``, or nothing.

        ``place`` is the database, for an error.
        """
        if sent is None:
            return self
        try:
            settings = Settings.model_validate_json(sent[1])
        except ValidationError:
            raise ProjectionMismatch(
                f"{place}: the map there has settings that this version of mapfold does not know;"
                f" run `{advised('replay')}`"
            ) from None
        constants = MapConstants.of(settings, self.cosines)
        return replace(self, settings_key=sent[0], settings=settings, constants=constants)

    def with_maps(self, key: str | None, maps: Mapping[str | None, OccupancyMap]) -> Self:
        """The constants after the maps of a key were read."""
        walls = {floor: WallMap(given) for floor, given in maps.items()}
        return replace(self, maps_key=key, walls=walls)


NOTHING_KNOWN: Final = KnownConstants()


class ConstantsMemory:
    """The constants and walls after the last question; for any thread, as they are replaced as a
    whole."""

    def __init__(self) -> None:
        self.known = NOTHING_KNOWN
