"""Constants of fusion by evidence (``fusion = "evidence"``), calibrated from a map's own revisits.

The defaults are priors, chosen on buildings of the developing half of our trial data;
`mapfold calibrate` replaces them by a map's own and records them as a ``use-settings`` command.

The likeness of two looks is not given as a cosine, whose scale depends on the embedding model
(different things lie near 0.1 with one model and near 0.75 with another), but as a *relative
likeness*: 0 for two different things of different classes, 1 for the same picture, that is (cosine
− different) / (1 − different). ``different`` is None by default: the fold then takes the mean
cosine of pairs in one picture, which are different things by construction, as it has seen them so
far.
"""

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from eventsrc.envelope.model import Text

_Positive = Annotated[float, Field(ge=0.001, le=1000.0)]
_Angle = Annotated[float, Field(ge=0.001, le=3.2)]
_Likeness = Annotated[float, Field(ge=-2.0, le=2.0)]
_Spread = Annotated[float, Field(ge=0.001, le=2.0)]


class EvidenceConstants(BaseModel):
    """Lengths in metres, angles in radians, spreads of a logarithm without unit."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    range_m: _Positive = 3.0
    """Median distance at which things are seen."""
    range_spread: _Spread = 0.55
    """Standard deviation of the logarithm of that distance."""
    bearing_rad: _Angle = 0.05
    """Standard error of the bearing of a box's centre, pose's heading included."""
    bearing_cut_rad: _Angle = 0.12
    """Standard error of the bearing of a box that the picture's border cuts at a side."""
    pose_m: _Positive = 0.08
    """Standard error of a mapped pose in each direction."""
    size_spread: _Spread = 0.3
    """Standard deviation of the logarithm of an instance's size about its class's median."""
    sizes_m: dict[Text, _Positive] = {}
    """Median height, in metres across the line of sight, of the boxes of a class that are not cut
    at top or bottom: height in pixels × depth / focal length."""
    different: Annotated[float, Field(ge=-1.0, lt=1.0)] | None = None
    """Mean cosine of different things of different classes; None for that of the pictures."""
    different_spread: _Spread = 0.12
    """Standard deviation of their relative likeness, whose mean is 0."""
    same_class: _Likeness = 0.47
    """Mean relative likeness of different things of one class."""
    same_class_spread: _Spread = 0.12
    same_back: _Likeness = 0.65
    """Mean relative likeness of one thing seen from opposite sides in one run."""
    same_side: _Likeness = 0.15
    """The gain of that likeness when both show the same side."""
    same_kappa: Annotated[float, Field(ge=0.001, le=100.0)] = 2.0
    """The decay of that gain with the change of side Δ: exp(kappa (cos Δ − 1))."""
    same_spread: _Spread = 0.09
    side_by: Literal["sight", "heading"] = "sight"
    """Whether the side is that of the line of sight or of the robot's heading."""
    session_shift: _Likeness = 0.13
    """The loss of likeness between two runs."""

    @field_validator("sizes_m")
    @classmethod
    def _in_order_of_names(cls, sizes: dict[str, float]) -> dict[str, float]:
        """One order, so that equal constants have one fingerprint."""
        return dict(sorted(sizes.items()))

    def __hash__(self) -> int:
        """Of the constants; pydantic copies a default that has none for every `Settings`."""
        return hash(self.model_dump_json())
