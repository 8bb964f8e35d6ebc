"""Advice on settings, where all poses are in one place or hardly any is in one, or no vector is of
the space that the settings name."""

from collections.abc import Mapping
from typing import Final

from eventsrc.base.text import advised, counted, visible
from projections.fold.settings import Settings

from .view import MapView

LEAST_POSES: Final = 20
"""The least number of posed keyframes for which advice is given."""
_MOSTLY: Final = 0.8


def space_advice(view: MapView) -> str | None:
    """One line where the settings name a space of which the map has no vector."""
    model = view.settings.embedding_model
    if model is None or not view.observations:
        return None
    if any(o.embedding_crc is not None and not o.foreign_space for o in view.observations):
        return None
    return (
        f"no detection has a vector of space {visible(model)}, so there are no Objects; the log's"
        f" spaces: `{visible(advised('log', 'spaces'))}`"
    )


def places_advice(counts: Mapping[str, int], settings: Settings) -> str | None:
    """One line that names the setting that helps; None where nothing stands out. ``counts`` are
    those of `MapView.counts`."""
    posed, noise, places = counts["poses"], counts["noise"], counts["places"]
    if posed < LEAST_POSES:
        return None
    if noise >= _MOSTLY * posed:
        return (
            f"{noise:,} of {counted(posed, 'keyframe')} with a pose are in no place; --preset rooms"
            " puts each into one"
        )
    if places != 1:
        return None
    but = f" but {noise:,}" if noise else ""
    found = f"all {counted(posed, 'keyframe')} with a pose{but} are in one place"
    if settings.places == "rooms":
        return (
            f"{found}; if that is more than one room, a smaller rooms.drive_m than"
            f" {settings.rooms.drive_m:g} tells them apart"
        )
    return f"{found}; if that is more than one room, --preset rooms tells them apart"
