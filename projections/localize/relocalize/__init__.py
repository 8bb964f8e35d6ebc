"""Re-localisation: ranked Places and a pose from a few object crops, as a pure ranking.

`rank` turns crops (`question`) and candidates into an `Answer`; candidates come from the databases
(`projections.postgres.queries.relocalize`) or from a folded map (`ExactIndex`).
"""

from .camera import Camera
from .candidates import NEIGHBOURS, CandidatePlace, Candidates, ExactIndex, Match, ObjectEstimate
from .certainty import UNKNOWN_BELOW
from .constants import MapConstants
from .question import Crop, Question, View, describe_value
from .ranking import (
    DEFAULT_CAMERA,
    Answer,
    Evidence,
    Method,
    PoseHypothesis,
    RankedPlace,
    rank,
)
from .reading import (
    MAX_QUESTION_BYTES,
    parse_json,
    parse_question,
    read_crops,
    read_moved,
    read_question,
)
from .schema import question_schema
from .track import Track, Tracked, movement_of
from .walls import WallMap

__all__ = [
    "DEFAULT_CAMERA",
    "MAX_QUESTION_BYTES",
    "NEIGHBOURS",
    "UNKNOWN_BELOW",
    "Answer",
    "Camera",
    "CandidatePlace",
    "Candidates",
    "Crop",
    "Evidence",
    "ExactIndex",
    "MapConstants",
    "Match",
    "Method",
    "ObjectEstimate",
    "PoseHypothesis",
    "Question",
    "RankedPlace",
    "Track",
    "Tracked",
    "View",
    "WallMap",
    "describe_value",
    "movement_of",
    "parse_json",
    "parse_question",
    "question_schema",
    "rank",
    "read_crops",
    "read_moved",
    "read_question",
]
