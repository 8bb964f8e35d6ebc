"""Parameters of the ranking, with where each comes from.

The similarity model: a crop of an object and an observation of the same object in another session,
seen from directions Δ apart, have a cosine near ``floor + side · exp(kappa · (cos Δ − 1))``. Floor,
side and kappa were read off house-a against house-b of the trial data: 0.863 seen from the same
direction, 0.831 at 50°, 0.78 from behind. The widths of the evidence (``sigma_*``), the price of an
unknown crop and the geometry's tolerances were chosen on generated buildings that are not among
those reported; docs/relocalization.md names them and `scripts/fit_confidence` fits the rest.
"""

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class Model:
    """Lengths in metres, angles in radians, similarities as cosines."""

    floor: float = 0.776
    side: float = 0.09
    kappa: float = 1.2
    sigma_observation: float = 0.016
    sigma_instance: float = 0.009
    independent: float = 6.0
    """Errors of one object's observations are correlated: no more than this many count."""
    too_similar: float = 3.0
    """A crop *more* like an object than expected is penalised no further than this χ²."""
    usual_best: float = 0.885
    """No observation counts as more similar than this."""
    same_crop: float = 0.04
    """An observation more similar than ``usual_best`` by this much is the very crop asked with."""
    same_crop_worth: float = 15.0
    """Log-likelihood that it adds to its landmark; decides between look-alikes."""
    usual_third: float = 0.875
    """A run whose third best match is above this is of the question's own session: all cosines
    against it are higher, and are shifted down (`sessions`)."""
    session: float = 0.048
    """By how much cosines within a session are higher than between two: 0.911 against 0.863 from
    the same side, in house-a and house-b as in home-1 and home-2."""
    session_price: float = 1.0
    """Log-likelihood that a landmark loses for each run it takes for the question's own session."""
    relevant: float = 0.72
    """Less similar observations show another thing and are ignored."""
    unknown_price: float = 7.0
    """Log-likelihood of a perfect match above that of 'this crop is not in the map'."""
    sigma_bearing: float = 0.04
    sigma_bearing_cut: float = 0.08
    sigma_log_depth: float = 0.15
    sigma_log_depth_cut: float = 0.3
    sigma_landmark: float = 0.1
    vague: float = 0.5
    """How much of the log of the error ellipse's area counts: a landmark of uncertain position fits
    everything a little, which must not score as high as a close fit of a certain one."""
    map_bearing: float = 0.02
    map_bearing_cut: float = 0.08
    map_log_depth: float = 0.08
    map_log_depth_cut: float = 0.3
    map_least: float = 0.06
    """Errors of the boxes a landmark is made of, radians and log; and metres on top."""
    sigma_size_least: float = 0.05
    gate: float = 5.0
    """χ² below which a point belongs to a landmark."""
    half_view: float = 0.55
    """Without boxes: the half of the field of view in which objects are expected."""
    usual_depth: float = 2.6
    usual_depth_spread: float = 0.45
    driven: float = 0.7
    """Standard deviation of the robot's distance from poses where robots have been."""
    driven_most: float = 2.5
    """Greatest penalty for it: a part of the building may not be explored yet."""
    seen_from: float = 4.0
    seen_from_no_box: float = 0.8
    """Standard deviation of the distance from poses that saw the landmark; without boxes the
    position depends on it alone."""


MODEL: Final = Model()
"""The defaults."""
