"""The rows of a `MapView`: what the map knows about each run, keyframe, observation, object, place.

Read them, do not write them: only `MapView.apply` does. ``ordinal`` numbers the things of a kind in
the order in which the fold met or founded them. Positions are integer micrometres (``_um``) and
exact; ``_m`` and ``_x``/``_y`` values are metres, correctly rounded. Times are robot seconds.
"""

from dataclasses import dataclass, field

from .deltas import Pose, UnitVector
from .exact import mean_m


@dataclass(slots=True, eq=False)
class RunRecord:
    """One run. ``started_at`` is the earliest keyframe timestamp of it so far."""

    ordinal: int
    run_id: str
    started_at: float
    keyframe_count: int = 0


@dataclass(slots=True, eq=False)
class PlaceRecord:
    """A region of the building. ``founder`` is the ordinal of its first core keyframe.

    ``survivor`` is the place that absorbed it; `MapView.places` lists only those without one.
    """

    ordinal: int
    place_id: str
    founder: int
    founded_offset: int
    keyframe_count: int = 0
    sum_x_um: int = 0
    sum_y_um: int = 0
    survivor: "PlaceRecord | None" = None
    unordered_members: list[int] = field(default_factory=list)

    @property
    def members(self) -> list[int]:
        """Ordinals of its keyframes, ascending; a new list each time."""
        return sorted(self.unordered_members)

    @property
    def centroid_x(self) -> float:
        """Metres; the mean of its members."""
        return mean_m(self.sum_x_um, self.keyframe_count)

    @property
    def centroid_y(self) -> float:
        """Metres; the mean of its members."""
        return mean_m(self.sum_y_um, self.keyframe_count)

    def current(self) -> "PlaceRecord":
        """The place that stands for this one now, itself unless it was absorbed."""
        place = self
        while place.survivor is not None:
            if place.survivor.survivor is not None:  # halve the path for the next one who asks
                place.survivor = place.survivor.survivor
            place = place.survivor
        return place


@dataclass(slots=True, eq=False)
class KeyframeRecord:
    """One keyframe. ``offset`` is its event's; ``pose`` is None when the robot had none."""

    ordinal: int
    offset: int
    run: int
    run_id: str
    keyframe_id: int
    timestamp: float
    pose: Pose | None
    observations: list[int] | tuple[()] = ()
    joined: PlaceRecord | None = None

    @property
    def place(self) -> int | None:
        """Ordinal of the place it belongs to now; None for noise or without a pose."""
        return None if self.joined is None else self.joined.current().ordinal


@dataclass(slots=True, eq=False)
class ObservationRecord:
    """One detection. ``object`` and ``similarity_q40`` are None when it was not fused.

    ``embedding`` is None when there is none, when it is of a foreign space, or when the view was
    made with ``keep_embeddings=False``; ``embedding_crc`` is there even then.
    """

    ordinal: int
    keyframe: int
    det_id: str
    class_name: str
    confidence: float
    bbox: tuple[float, float, float, float]
    embedding_model: str | None
    embedding: UnitVector | None
    embedding_crc: int | None
    foreign_space: bool
    object: int | None = None
    similarity_q40: int | None = None


@dataclass(slots=True, eq=False)
class ObjectRecord:
    """A landmark. ``observations`` are ordinals in the order in which they were fused."""

    ordinal: int
    object_id: str
    class_name: str
    obs_count: int = 0
    sum_x_um: int = 0
    sum_y_um: int = 0
    first_seen: float = 0.0
    last_seen: float = 0.0
    place: int | None = None
    observations: list[int] = field(default_factory=list)

    @property
    def mean_x(self) -> float:
        """Metres; the mean of the robot's positions that saw it."""
        return mean_m(self.sum_x_um, self.obs_count)

    @property
    def mean_y(self) -> float:
        """Metres; the mean of the robot's positions that saw it."""
        return mean_m(self.sum_y_um, self.obs_count)
