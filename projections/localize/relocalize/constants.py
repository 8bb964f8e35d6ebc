"""Constants of a map that the localiser needs beside its observations: `MapConstants`.

How alike different things look depends on the embedding model, so it is measured on the map itself:
two detections of one picture with different labels are two things. The sample is bounded and
follows from the number of observations alone (`Sample`), so that a folded map and the databases
take the same one; once there are more than a thousand, it changes only when their number has
doubled.
"""

import math
from dataclasses import dataclass, field
from typing import Final, NamedTuple, Self

from projections.fold.evidence import EvidenceConstants
from projections.fold.settings import LocalizerConstants, Settings

from .camera import Camera

SAMPLED: Final = 1_024
"""The most observations that are compared with others of their picture."""
FOLLOWERS: Final = 3
"""The number of following observations that each one is compared with."""
_GUESS: Final = 0.5
_GUESS_WEIGHT: Final = 0.5
_SPREAD_WEIGHT: Final = 10.0
_DIGITS: Final = 4
"""Digits that cosines are rounded to: those of a database are sums of float32, and rounded they
nearly always equal exact ones."""


class Sample(NamedTuple):
    """The observations with the ordinals ``stride`` - 1, 2 ``stride`` - 1 … below ``limit``."""

    limit: int
    stride: int

    @classmethod
    def of(cls, count: int) -> Self:
        """The sample of a map whose last observation with an embedding is number ``count``,
        from 1."""
        if count <= SAMPLED:
            return cls(count, 1)
        limit = 1 << (count.bit_length() - 1)
        return cls(limit, max(1, limit // SAMPLED))


class Cosines(NamedTuple):
    """Number, mean and standard deviation of cosines."""

    number: int = 0
    mean: float = 0.0
    deviation: float = 0.0


@dataclass(frozen=True, slots=True)
class MapConstants:
    """The constants in force in a map, and how alike different things are in it.

    ``evidence`` and ``localizer`` are those of the settings, priors where the map was never
    calibrated; ``camera`` is that of mapped envelopes. ``different`` is the mean cosine of
    different things in one picture and ``different_spread`` their standard deviation.
    """

    evidence: EvidenceConstants = field(default_factory=EvidenceConstants)
    camera: Camera = field(default_factory=Camera)
    localizer: LocalizerConstants = field(default_factory=LocalizerConstants)
    different: float = _GUESS
    different_spread: float = 0.06

    @classmethod
    def of(cls, settings: Settings, cosines: Cosines) -> Self:
        """The constants of a map with these settings and these cosines of different things; if the
        cosines are few, their mean and deviation are shrunk towards a guess."""
        evidence, camera = settings.evidence, settings.camera
        different = evidence.different
        if different is None:
            total = cosines.number * cosines.mean + _GUESS_WEIGHT * _GUESS
            different = min(total / (cosines.number + _GUESS_WEIGHT), 0.999)
        usual = evidence.different_spread * (1.0 - different)
        square = cosines.number * cosines.deviation**2 + _SPREAD_WEIGHT * usual**2
        return cls(
            evidence,
            Camera(camera.width_px, camera.height_px, camera.hfov_deg, camera.yaw_rad),
            settings.localizer,
            round(different, _DIGITS),
            max(round(math.sqrt(square / (cosines.number + _SPREAD_WEIGHT)), _DIGITS), 1e-3),
        )
