"""Constants of places by rooms (``places = "rooms"``), chosen on the developing half of the trial
data; docs/places.md has the rule and what was tried."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator

MOST_CELLS = 20
"""Most cells' radii in ``drive_m``; what a new link costs grows with the square of it."""
_Length = Annotated[float, Field(ge=0.01, le=100.0)]


class RoomsConstants(BaseModel):
    """Lengths in metres."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    cell_m: _Length = 0.75
    """A pose farther than this from all anchors becomes the anchor of a new cell."""
    drive_m: Annotated[_Length, Field(validate_default=True)] = 4.0
    """Places join up to this mean driven distance between their cells."""

    @field_validator("drive_m")
    @classmethod
    def _is_few_cells(cls, drive_m: float, info: ValidationInfo) -> float:
        cell_m = info.data.get("cell_m")
        if cell_m is not None and drive_m > MOST_CELLS * cell_m:
            raise ValueError(f"is more than {MOST_CELLS} times cell_m, which is {cell_m:g}")
        return drive_m
