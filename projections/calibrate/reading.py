"""From the observations of a folded map to constants: one round of a calibration."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from projections.evidence import EvidenceConstants

from .geometry import camera_faults, errors, ranges, sizes
from .looks import different, in_pictures, of_things, same, scale
from .shrinking import Reading, unread
from .sightings import Sightings
from .things import qualified


@dataclass(frozen=True, slots=True)
class Round:
    """What one round read: the constants, each with what it rests on, and how many things and
    observations qualified. ``camera`` is what stands out about the camera."""

    constants: EvidenceConstants
    readings: tuple[Reading, ...]
    sizes: tuple[Reading, ...]
    things: int
    observations: int
    camera: tuple[Reading, ...]


def read(seen: Sightings, used: EvidenceConstants, prior: EvidenceConstants) -> Round:
    """Read the constants off a map that was folded with ``used``, drawn towards ``prior``."""
    with np.errstate(all="ignore"):  # of nonsense; what is not finite is left to the prior
        return _read(seen, used, prior)


def _read(seen: Sightings, used: EvidenceConstants, prior: EvidenceConstants) -> Round:
    things = qualified(seen, used.bearing_rad, used.bearing_cut_rad, used.pose_m)
    found: list[Reading] = [*ranges(things, prior), *errors(things, seen, prior)]
    by_class, about = sizes(things, seen, prior)
    found.append(about)
    cosines, same_class = in_pictures(seen)
    scaled_by = scale(cosines, same_class)
    found.append(scaled_by)
    zero = scaled_by.value if isinstance(scaled_by.value, float) else prior.different
    if zero is None:
        names = (
            "different_spread", "same_class", "same_class_spread", "same_back", "same_side",
            "same_kappa", "same_spread", "side_by", "session_shift",
        )  # fmt: skip
        found += [unread(name, getattr(prior, name)) for name in names]
    else:
        found += different((cosines - zero) / (1.0 - zero), same_class, prior)
        found += same(of_things(seen, things, zero), prior).values()
    found = [_bounded(reading) for reading in found]
    by_class = {name: _bounded(reading, "sizes_m") for name, reading in by_class.items()}
    values: dict[str, Any] = {reading.name: reading.value for reading in found}
    values["sizes_m"] = {name: reading.value for name, reading in by_class.items()}
    return Round(
        EvidenceConstants(**values),
        tuple(found),
        tuple(by_class.values()),
        len(things),
        sum(len(thing.rows) for thing in things),
        tuple(camera_faults(things, seen)),
    )


def _bounded(reading: Reading, group: str | None = None) -> Reading:
    """The reading with a value that the settings take: a map of nonsense may show more."""
    if not isinstance(reading.value, float):
        return reading
    least, most = _bounds(group or reading.name)
    return replace(reading, value=min(max(reading.value, least), most))


_FIELDS: dict[str, Any] = EvidenceConstants.model_json_schema()["properties"]


def _bounds(name: str) -> tuple[float, float]:
    """The least and the greatest value of a constant; of each entry's value where it is a table."""
    (rule,) = _FIELDS[name].get("patternProperties", {name: _FIELDS[name]}).values()
    return rule.get("minimum", -math.inf), rule.get("maximum", math.inf)
