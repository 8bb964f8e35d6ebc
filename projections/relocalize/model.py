"""Every number the ranking relies on, with where it comes from.

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
    """Observations of one object err alike: more than this many count no more."""
    too_similar: float = 3.0
    """A crop *more* like an object than expected is penalised no further than this χ²."""
    usual_best: float = 0.885
    """No observation counts as more similar than this."""
    same_crop: float = 0.04
    """Beyond that by this much, the crop is the very one in the map …"""
    same_crop_worth: float = 15.0
    """… which decides between look-alikes."""
    usual_third: float = 0.875
    """A third best match in a run above this tells that the run is of the question's own session:
    then all cosines against it are higher, and are shifted down (`sessions`)."""
    session: float = 0.048
    """By how much cosines within a session are higher than between two: 0.911 against 0.863 from
    the same side, in house-a and house-b as in home-1 and home-2."""
    session_price: float = 1.0
    """Log-likelihood that a landmark loses for each run it takes for the question's own session."""
    relevant: float = 0.72
    """Less similar observations show another model and are not looked at."""
    unknown_price: float = 7.0
    """Log-likelihood a perfect match has over 'this crop is not in the map'."""
    sigma_bearing: float = 0.04
    sigma_bearing_cut: float = 0.08
    sigma_log_depth: float = 0.15
    sigma_log_depth_cut: float = 0.3
    sigma_landmark: float = 0.1
    vague: float = 0.5
    """How much of the log of the error ellipse's area counts: a landmark whose place is vague fits
    everything a little, which must not be worth as much as one that fits sharply."""
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
    """The robot is where it has been before, within about this …"""
    driven_most: float = 2.5
    """… unless three things speak against it: half of a building may not be explored yet."""
    seen_from: float = 4.0
    seen_from_no_box: float = 0.8
    """… and sees an object from about where that was seen before; without boxes all hangs on it."""


MODEL: Final = Model()
"""The shipped numbers."""
