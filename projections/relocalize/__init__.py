"""Where am I? Ranked Places and a pose from a few object crops, as a pure ranking.

`rank` turns crops and candidates into an `Answer`; candidates come from the databases
(`projections.queries.relocalize`) or from a folded map (`ExactIndex`).
"""

from .answer import Answer, Evidence, PoseHypothesis, RankedPlace
from .camera import Camera
from .candidates import NEIGHBOURS, Candidates, Match, Spot
from .exact_search import ExactIndex
from .pose import UNKNOWN_BELOW
from .question import Crop, parse_json, parse_question, read_crops, shown
from .ranking import DEFAULT_CAMERA, Method, rank

__all__ = [
    "DEFAULT_CAMERA",
    "NEIGHBOURS",
    "UNKNOWN_BELOW",
    "Answer",
    "Camera",
    "Candidates",
    "Crop",
    "Evidence",
    "ExactIndex",
    "Match",
    "Method",
    "PoseHypothesis",
    "RankedPlace",
    "Spot",
    "parse_json",
    "parse_question",
    "rank",
    "read_crops",
    "shown",
]
