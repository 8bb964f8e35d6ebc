"""The shapes of answers, for the description at ``/openapi.json``.

Answers are not validated by these models; tests check that every answer sent has the described
shape. A key that is not required is absent rather than null. Later versions may add keys.
"""

from typing import Annotated, Literal, NotRequired

from pydantic import BaseModel, Field
from typing_extensions import TypedDict  # pydantic needs it before Python 3.12

from .states import CURSOR, DEFAULT_PAGE, DEFAULT_RADIUS_M, MAX_METRES, MAX_PAGE

Probability = Annotated[float, Field(ge=0, le=1)]
Metres = Annotated[float, Field(description="Metres in the map's frame.")]


class EvidenceShape(TypedDict):
    """An observation in the map that supports a Place."""

    det_id: str
    object_id: Annotated[str | None, Field(description="Null where it is of no Object.")]
    class_name: str
    similarity: Annotated[
        float, Field(description="Of the embeddings; 1 where the crop was a class alone.")
    ]


class RankedPlaceShape(TypedDict):
    """A Place where the robot may be."""

    place_id: str
    score: Annotated[
        float,
        Field(
            description="The share of the poses' weight that lies in it; with the method plain the"
            " sum of similarities."
        ),
    ]
    centroid_x: Metres
    centroid_y: Metres
    evidence: list[EvidenceShape]
    name: NotRequired[str]
    floor: NotRequired[str]


class PoseShape(TypedDict):
    """The robot's pose in the map frame."""

    x: Metres
    y: Metres
    yaw: Annotated[
        float | None, Field(description="Radians; null where the evidence leaves it open.")
    ]
    spread_m: Annotated[
        float, Field(ge=0, description="Root mean square distance of all weighed poses from it.")
    ]
    floor: NotRequired[str]


KnownSpread = Annotated[
    float | None,
    Field(description="Standard deviation of known; null without embeddings."),
]


class TrackShape(TypedDict):
    """The robot's pose by all questions of a session."""

    pose: PoseShape | None
    confidence: Probability
    known: Probability
    known_spread: KnownSpread
    questions: Annotated[int, Field(ge=1, description="Questions of the session so far.")]


class AnswerShape(TypedDict):
    """Where a robot that sees these things may be."""

    places: Annotated[list[RankedPlaceShape], Field(description="The likeliest first.")]
    pose: PoseShape | None
    confidence: Annotated[
        float, Field(ge=0, le=1, description="Probability that the pose is right within 1.5 m.")
    ]
    known: Annotated[
        float, Field(ge=0, le=1, description="Probability that the map has one of the things.")
    ]
    known_spread: KnownSpread
    unknown: Annotated[bool, Field(description="Whether the map likely has none (known < 0.5).")]
    thin: Annotated[
        str | None, Field(description="What the map has too little of; null where it has enough.")
    ]
    track: NotRequired[Annotated[TrackShape, Field(description="Present if a session was given.")]]


class Place(TypedDict):
    """A region of the building."""

    place_id: str
    centroid_x: Metres
    centroid_y: Metres
    keyframe_count: Annotated[int, Field(ge=0)]
    name: NotRequired[str]
    floor: NotRequired[str]
    type: NotRequired[Annotated[str, Field(description="The type of room, absent if unsure.")]]
    type_probability: NotRequired[Probability]
    distance_m: NotRequired[
        Annotated[float, Field(ge=0, description="From the position, where one was given.")]
    ]


class MapObject(TypedDict):
    """A thing in the building."""

    object_id: str
    class_name: str
    mean_x: Annotated[float, Field(description="Mean position of the robots that saw it.")]
    mean_y: float
    obs_count: Annotated[int, Field(ge=0)]
    first_seen: Annotated[float, Field(description="Seconds since 1970.")]
    last_seen: float
    first_seen_iso: Annotated[str, Field(description="ISO 8601, UTC.")]
    last_seen_iso: str
    confirmed: NotRequired[
        Annotated[bool, Field(description="Whether it was seen from two spots or at two times.")]
    ]
    est_x: NotRequired[
        Annotated[float, Field(description="Estimated position, under fusion by evidence.")]
    ]
    est_y: NotRequired[float]
    est_sigma_m: NotRequired[float]
    est_xx: NotRequired[float]
    est_xy: NotRequired[float]
    est_yy: NotRequired[float]
    est_spots: NotRequired[int]
    z: NotRequired[
        Annotated[float, Field(description="Median height of its middle, where it was measured.")]
    ]
    size: NotRequired[
        Annotated[list[float], Field(description="Median length, width and height, metres.")]
    ]
    missing: NotRequired[
        Annotated[bool, Field(description="Whether it was not seen where it should have been.")]
    ]
    place_id: NotRequired[
        Annotated[
            str | None,
            Field(description="The Place it is in, null for none; in lists without a position."),
        ]
    ]
    place_name: NotRequired[str]
    distance_m: NotRequired[
        Annotated[float, Field(ge=0, description="From the position, where one was given.")]
    ]


Next = Annotated[
    str | None,
    Field(description="The cursor of the next page, null on the last; in lists without a position"),
]


class PlacesShape(TypedDict):
    """Places: nearest first, or in the order of their founding where no position was given."""

    places: list[Place]
    next: NotRequired[Next]


class ObjectsShape(TypedDict):
    """Objects: nearest first, or in the order of their founding where no position was given."""

    objects: list[MapObject]
    next: NotRequired[Next]


class Health(TypedDict):
    """Questions can be answered."""

    status: Literal["ok"]


class Error(TypedDict):
    """Why a request was refused."""

    kind: Annotated[
        Literal["bad_question", "refused", "too_much", "database", "failed"],
        Field(
            description="bad_question: the request is wrong; refused: it is not allowed; too_much:"
            " ask again later; database: it cannot be queried now; failed: a fault of the service."
        ),
    ]
    message: Annotated[str, Field(description="For people: what is wrong, and what to send.")]


class RefusalShape(TypedDict):
    """Every response with a status of 400 or more."""

    error: Error


for _shape in [each for name, each in vars().items() if name.endswith("Shape")]:
    # Clients know them by these names. pydantic names components after the class, and a title in
    # its configuration changes only the title.
    _shape.__name__ = _shape.__qualname__ = _shape.__name__.removesuffix("Shape")


class StateQuery(BaseModel):
    """Parameters of a question about the state."""

    x: Annotated[float, Field(ge=-MAX_METRES, le=MAX_METRES)] | None = Field(
        None, description="Metres in the map's frame."
    )
    y: Annotated[float, Field(ge=-MAX_METRES, le=MAX_METRES)] | None = Field(
        None, description="Metres in the map's frame."
    )
    radius: Annotated[float, Field(ge=0, le=MAX_METRES)] | None = Field(
        None, description=f"{DEFAULT_RADIUS_M:g} metres if not given."
    )
    limit: Annotated[int, Field(ge=1, le=MAX_PAGE)] | None = Field(
        None, description=f"Most items; without a position {DEFAULT_PAGE} if not given."
    )
    cursor: Annotated[str, Field(pattern=CURSOR)] | None = Field(
        None, description="`next` of the previous page."
    )
