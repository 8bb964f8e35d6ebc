"""Constants of re-localisation that a map's own questions can tell.

`projections.relocalize` has two numbers beside a pose: `known`, whether the things shown are in the
map, and `confidence`, whether the pose is within 1.5 m. Both are logistic models with weights for
all maps; here is how far those are off on one map. `mapfold calibrate` asks the map about its own
keyframes and records the correction with the number of questions that it rests on.
"""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

_Shift = Annotated[float, Field(ge=-10.0, le=10.0)]
_Scale = Annotated[float, Field(ge=0.1, le=10.0)]
_Count = Annotated[int, Field(ge=0)]


class LocalizerConstants(BaseModel):
    """Corrections of a logit z: scale · z + shift. The defaults change nothing."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    known_shift: _Shift = 0.0
    known_scale: _Scale = 1.0
    known_count: _Count = 0
    """How many of the map's own questions the correction of `known` rests on; 0 for none."""
    confidence_shift: _Shift = 0.0
    confidence_scale: _Scale = 1.0
    confidence_count: _Count = 0
    text_shift: Annotated[float, Field(ge=-2.0, le=2.0)] = 0.45
    """What a text's cosine with a picture is below that of two pictures of different things of
    one class: added to it before it is compared with cosines of pictures."""
