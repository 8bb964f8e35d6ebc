"""What comes back: ranked Places with evidence, a pose hypothesis, and how sure we are."""

from dataclasses import dataclass
from typing import Any

from .pose import UNKNOWN_BELOW


@dataclass(frozen=True, slots=True)
class Evidence:
    """An observation in the map that speaks for a Place. ``object_id`` is None if unfused."""

    det_id: str
    object_id: str | None
    class_name: str
    similarity: float


@dataclass(frozen=True, slots=True)
class RankedPlace:
    """A Place and its score: the share of the pose hypotheses' weight that lies in it.

    With the plain method the score is the sum of similarities. The centroid is in metres.
    """

    place_id: str
    score: float
    centroid_x: float
    centroid_y: float
    evidence: tuple[Evidence, ...]


@dataclass(frozen=True, slots=True)
class PoseHypothesis:
    """Metres and radians in the map frame; ``yaw`` is None when the evidence leaves it open.

    ``spread_m`` is the root mean square distance of all weighed hypotheses from the pose.
    """

    x: float
    y: float
    yaw: float | None
    spread_m: float


@dataclass(frozen=True, slots=True)
class Answer:
    """``confidence`` is the calibrated probability that the pose is right within 1.5 m."""

    places: tuple[RankedPlace, ...]
    pose: PoseHypothesis | None
    confidence: float

    @property
    def unknown(self) -> bool:
        """True when the honest answer is: I do not know where this is."""
        return self.confidence < UNKNOWN_BELOW

    def document(self) -> dict[str, Any]:
        """The answer as JSON, in the shape of ``relocalize --json``."""
        return {
            "places": [_place(place) for place in self.places],
            "pose": None if self.pose is None else _pose(self.pose),
            "confidence": self.confidence,
            "unknown": self.unknown,
        }


def _place(place: RankedPlace) -> dict[str, Any]:
    return {
        "place_id": place.place_id,
        "score": place.score,
        "centroid_x": place.centroid_x,
        "centroid_y": place.centroid_y,
        "evidence": [
            {
                "det_id": e.det_id,
                "object_id": e.object_id,
                "class_name": e.class_name,
                "similarity": e.similarity,
            }
            for e in place.evidence
        ],
    }


def _pose(pose: PoseHypothesis) -> dict[str, Any]:
    return {"x": pose.x, "y": pose.y, "yaw": pose.yaw, "spread_m": pose.spread_m}
