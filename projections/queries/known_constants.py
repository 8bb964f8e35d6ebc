"""A map's constants in the databases, remembered between questions.

A question carries the keys of what is known; the databases send cosines and settings again only
where theirs have other keys. So constants cost no round trip, and little time after the first
question.
"""

from dataclasses import dataclass, field, replace
from typing import Any, Final, Self

from pydantic import ValidationError

from projections.errors import ProjectionMismatch
from projections.relocalize import MapConstants
from projections.relocalize.constants import FOLLOWERS, SAMPLED, Cosines
from projections.settings import Settings


@dataclass(frozen=True, slots=True)
class KnownConstants:
    """Constants, and the keys under which the databases have what they are made of."""

    cosines_key: str | None = None
    cosines: Cosines = field(default_factory=Cosines)
    settings_key: str | None = None
    settings: Settings = field(default_factory=Settings)
    constants: MapConstants = field(default_factory=MapConstants)

    @property
    def parameters(self) -> dict[str, Any]:
        """Those of the statements."""
        return {
            "known_cosines": self.cosines_key,
            "known_settings": self.settings_key,
            "sampled": SAMPLED,
            "followers": FOLLOWERS,
        }

    def with_cosines(self, sent: list[Any] | None) -> Self:
        """What is known after the databases have sent ``[key, number, mean, deviation]``, or
        nothing."""
        if sent is None:
            return self
        cosines = Cosines(*sent[1:])
        constants = MapConstants.of(self.settings, cosines)
        return replace(self, cosines_key=sent[0], cosines=cosines, constants=constants)

    def with_settings(self, sent: list[str] | None, place: str) -> Self:
        """What is known after the databases have sent ``[fingerprint, settings]``, or nothing.

        ``place`` is the database, for an error.
        """
        if sent is None:
            return self
        try:
            settings = Settings.model_validate_json(sent[1])
        except ValidationError:
            raise ProjectionMismatch(
                f"{place}: the map there has settings that this version of mapfold does not know;"
                " run mapfold replay LOG"
            ) from None
        constants = MapConstants.of(settings, self.cosines)
        return replace(self, settings_key=sent[0], settings=settings, constants=constants)


NOTHING_KNOWN: Final = KnownConstants()


class ConstantsMemory:
    """The constants that the last question has learned; for any thread, as they are replaced as a
    whole."""

    def __init__(self) -> None:
        self.known = NOTHING_KNOWN
