"""Constants of places by rooms (``places = "rooms"``), chosen on the developing half of the trial
data; docs/places.md has the rule and what was tried."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

_Length = Annotated[float, Field(ge=0.01, le=100.0)]


class RoomsConstants(BaseModel):
    """Lengths in metres."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    cell_m: _Length = 0.75
    """A pose farther than this from all anchors becomes the anchor of a new cell."""
    drive_m: _Length = 4.0
    """Places join up to this mean driven distance between their cells."""
