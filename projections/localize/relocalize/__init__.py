"""Re-localisation: ranked Places and a pose from a few object crops, as a pure ranking.

`rank` turns crops (`question`) and candidates into an `Answer`; candidates come from the databases
(`projections.postgres.queries.candidate_search`) or from a folded map (`ExactIndex`).
"""

from .candidates import NEIGHBOURS, CandidatePlace, ExactIndex, MapCandidates, Match, ObjectEstimate
from .certainty import UNKNOWN_BELOW
from .constants import MapConstants
from .ground import WallMap
from .question import Question, QuestionCrop, QuestionView, describe_value
from .ranking import Answer, Evidence, Method, PoseHypothesis, RankedPlace, rank
from .reading import (
    MAX_QUESTION_BYTES,
    parse_json,
    parse_question,
    question_schema,
    read_moved,
    read_question,
)

__all__ = [
    "MAX_QUESTION_BYTES",
    "NEIGHBOURS",
    "UNKNOWN_BELOW",
    "Answer",
    "CandidatePlace",
    "Evidence",
    "ExactIndex",
    "MapCandidates",
    "MapConstants",
    "Match",
    "Method",
    "ObjectEstimate",
    "PoseHypothesis",
    "Question",
    "QuestionCrop",
    "QuestionView",
    "RankedPlace",
    "WallMap",
    "describe_value",
    "parse_json",
    "parse_question",
    "question_schema",
    "rank",
    "read_moved",
    "read_question",
]
