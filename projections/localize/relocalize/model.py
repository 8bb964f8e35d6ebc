"""Parameters of the ranking that hold for all maps; constants of one map are in `MapConstants`.

`MapConstants` has the usual distance of things, the error of bearings and the likeness of one thing
and of two (`projections.fold.evidence`). The parameters here were chosen on the developing half of
the trial data (docs/relocalization.md).
"""

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class Model:
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


MODEL: Final = Model()
"""The defaults."""
