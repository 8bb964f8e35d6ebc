"""What the localiser needs beside observations: constants of one map, parameters for all maps.

`MapConstants` has the usual distance of things, the error of bearings and the likeness of one thing
and of two (`projections.fold.evidence`).

How alike different things look depends on the embedding model, so it is measured on the map itself:
two detections of one picture with different labels are two things. The sample is bounded and
follows from the number of observations alone (`Sample`), so that a folded map and the databases
take the same one; once there are more than a thousand, it changes only when their number has
doubled.

The parameters of `RankingModel` hold for all maps. They were chosen on the developing half of the
trial data (docs/relocalization.md).
"""

import math
from dataclasses import dataclass, field
from typing import Final, NamedTuple, Self

from projections.fold.evidence import EvidenceConstants
from projections.fold.settings import CameraConstants, LocalizerConstants, Settings

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


class SessionPrior(NamedTuple):
    """What another day costs beyond that of the weights of `known`, as an addition to its logit:
    mean and standard deviation."""

    mean: float
    spread: float

    @classmethod
    def of(cls, evidence: EvidenceConstants) -> "SessionPrior":
        """The prior of a map: wide unless the shift between its runs was read."""
        lost = evidence.session_shift - EvidenceConstants().session_shift
        if not lost:
            return ANY_DAY
        return cls(_OF_USUAL_DAY + _LOGIT_OF_LIKENESS * lost, _READ_DAY_SPREAD)


_LOGIT_OF_LIKENESS: Final = 24.0
"""What likeness adds to the logit of `known` (`certainty.KNOWN_WEIGHTS`)."""
_OF_USUAL_DAY, _READ_DAY_SPREAD = 0.3, 0.75
ANY_DAY: Final = SessionPrior(1.2, 1.2)
"""Where nothing is known of what a day costs; chosen on generated buildings where half of the days
cost twice as much as those of the weights."""
USUAL_DAY: Final = SessionPrior(0.0, _READ_DAY_SPREAD)
"""Of a map's own questions, whose likenesses are lowered by what a day costs."""


@dataclass(frozen=True, slots=True)
class MapConstants:
    """The constants in force in a map, and how alike different things are in it.

    ``evidence`` and ``localizer`` are those of the settings, priors where the map was never
    calibrated; ``camera`` is that of mapped envelopes. ``different`` is the mean cosine of
    different things in one picture and ``different_spread`` their standard deviation; ``session``
    is what another day may cost.
    """

    evidence: EvidenceConstants = field(default_factory=EvidenceConstants)
    camera: CameraConstants = field(default_factory=CameraConstants)
    localizer: LocalizerConstants = field(default_factory=LocalizerConstants)
    different: float = _GUESS
    different_spread: float = 0.06
    session: SessionPrior = ANY_DAY

    @classmethod
    def of(cls, settings: Settings, cosines: Cosines) -> Self:
        """The constants of a map with these settings and these cosines of different things; if the
        cosines are few, their mean and deviation are shrunk towards a guess."""
        evidence = settings.evidence
        different = evidence.different
        if different is None:
            total = cosines.number * cosines.mean + _GUESS_WEIGHT * _GUESS
            different = min(total / (cosines.number + _GUESS_WEIGHT), 0.999)
        usual = evidence.different_spread * (1.0 - different)
        square = cosines.number * cosines.deviation**2 + _SPREAD_WEIGHT * usual**2
        return cls(
            evidence,
            settings.camera.constants,
            settings.localizer,
            round(different, _DIGITS),
            max(round(math.sqrt(square / (cosines.number + _SPREAD_WEIGHT)), _DIGITS), 1e-3),
            SessionPrior.of(evidence),
        )


@dataclass(frozen=True, slots=True)
class RankingModel:
    """Lengths in metres, angles in radians; likeness is relative (`projections.fold.evidence`)."""

    # How a crop is explained: see `likelihood`.
    in_map: float = 0.85
    """Prior probability that a crop's thing is in the map."""
    share: float = 0.5
    """Likelihood ratio of a landmark that fits no better than a thing anywhere would."""
    tail: float = 0.03
    """The weight of a landmark that is roughly in front, whatever its box."""
    twice: float = 2.0
    """The distance up to which a landmark is in front, in multiples of the usual distance."""
    seen_from_m: float = 1.6
    """Standard deviation of the distance to the nearest pose that saw the landmark: walls are not
    in the map."""

    through_walls: float = 0.3
    """The factor of a landmark behind a wall; above 0, because its position is an estimate."""
    in_walls: float = 0.1
    """The factor of a pose inside a wall; above 0, because poses have errors."""

    # Where robots are: see `pose`.
    driven_m: float = 0.6
    driven_far_m: float = 1.5
    driven_share: float = 0.4
    """Distances from poses that saw a landmark: a mixture of two normal distributions."""
    reach_m: float = 1.6
    """No pose farther than this from all of those is considered."""

    # Looks: see `appearance`.
    best_pairs: int = 4
    """The number of observations of a landmark that count; with fewer, each missing one costs
    ``missing``."""
    missing: float = 0.5
    most: float = 8.0
    """Limit of a landmark's log-likelihood ratio by its looks."""
    look_alike: float = 0.15
    """Share of look-alikes among the different things that resemble a crop, which are as like as
    the thing itself but for ``look_alike_below``; and of other things of the class."""
    look_alike_below: float = 0.04
    of_class: float = 0.35
    least_spread: float = 0.06
    """The least spread of a thing's likenesses."""
    own_spread: float = 0.4
    """Share of their variance that is not common to all likenesses of a landmark to a crop."""
    independent: float = 6.0
    """The most likenesses of a landmark that count, since they are correlated."""
    side_weight: float = 0.85
    """The weight of the log-likelihood by the side of view."""
    same_picture: float = 0.98
    """A likeness above this is to the crop itself; the robot then looks from there, as exp(kappa
    (cos Δ − 1))."""
    same_picture_kappa: float = 50.0
    text_weight: float = 0.5
    """The weight of the log ratio when the crop is a text."""
    class_ratio: float = 1.5
    """Log-likelihood ratio of a landmark that has the class of a crop without an embedding."""

    # Boxes: see `landmarks` and `likelihood`.
    pose_m: float = 0.1
    size_spread: float = 0.2
    """Standard deviation of the logarithm of a landmark's height in a box, beside the error common
    to all boxes."""
    other_sizes: float = 0.7
    """Standard deviation of the logarithm of the height of any other thing."""
    edge_m: float = 0.08
    edge_part: float = 0.1
    """Standard error of an edge's elevation, and what a part of the elevation adds."""
    edge_rise: float = 0.02
    other_rises: float = 0.25
    """Standard error of the rise of a line of sight, and that of any other thing."""


MODEL: Final = RankingModel()
"""The defaults."""
