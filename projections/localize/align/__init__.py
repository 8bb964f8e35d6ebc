"""The rigid transform between two map frames, from the Objects that both maps have."""

from .alignment import Alignment, align, decision_text
from .framed_things import FramedThings, map_of_runs, things_of_map
from .matching import moved

__all__ = [
    "Alignment",
    "FramedThings",
    "align",
    "decision_text",
    "map_of_runs",
    "moved",
    "things_of_map",
]
