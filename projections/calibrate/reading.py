"""From the observations of a folded map to constants: one round of a calibration."""

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


_LEAST = 0.001
_BOUNDS: dict[str, tuple[float, float]] = {
    "range_m": (_LEAST, 1000.0),
    "sizes_m": (_LEAST, 1000.0),
    "pose_m": (_LEAST, 1000.0),
    "bearing_rad": (_LEAST, 3.2),
    "bearing_cut_rad": (_LEAST, 3.2),
    "range_spread": (_LEAST, 2.0),
    "size_spread": (_LEAST, 2.0),
    "different_spread": (_LEAST, 2.0),
    "same_class_spread": (_LEAST, 2.0),
    "same_spread": (_LEAST, 2.0),
    "same_class": (-2.0, 2.0),
    "same_back": (-2.0, 2.0),
    "same_side": (-2.0, 2.0),
    "session_shift": (-2.0, 2.0),
}
"""What `EvidenceConstants` takes: a map of nonsense may show more."""


def _bounded(reading: Reading, group: str | None = None) -> Reading:
    """The reading with a value that the settings take."""
    bounds = _BOUNDS.get(group or reading.name)
    if bounds is None or not isinstance(reading.value, float):
        return reading
    return replace(reading, value=min(max(reading.value, bounds[0]), bounds[1]))
