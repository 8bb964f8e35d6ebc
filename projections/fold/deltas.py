"""Deltas: what an event changed in the map. The contract between the fold and all that uses it.

Sinks, the view and time travel are built from deltas and never look into a reducer. A delta carries
*absolute* new values (a count, not an increment): the last one per thing is enough, and applying
one twice does no harm. ``offset`` is that of the event that caused it, perhaps no keyframe.

Ordinals number the things of one kind 0, 1, 2 … in the order in which the fold met or founded them.
They are never reused; a database's ids are computed from them. Mypy keeps those of kinds apart.

Positions are integer micrometres in the map frame (``_um``), so that sums and comparisons are exact
(`projections.fold.exact`). Timestamps are the robot's, float seconds.

The deltas of one event come in this order: RunSeen, FrameJoined, KeyframeAdded, ObservationAdded …,
then places (PlaceFormed, PlacesMerged, MergeRefused, KeyframePlaced, PlaceChanged, PlaceNamed),
Objects (ObjectFound / ObjectSeen, ObjectsMerged / ObjectRelocated, ObjectClassified,
ObjectEstimated, ObjectMissing), located-in (ObjectMoved), adjacency (PlacesLinked). A MapGiven is
alone or precedes places. A delta names only things that deltas before it have introduced; an
ObjectRelocated stands right after the ObjectsMerged that makes what is found elsewhere part of it.

A msgspec struct takes a third of the time of a frozen dataclass; with ``gc=False`` the garbage
collector does not traverse them.
"""

from typing import Literal, NewType, TypeAlias

import msgspec
import numpy as np
from numpy.typing import NDArray

from eventsrc.envelope.model import DetId, KeyframeId, Offset, RunId, StatedCamera
from eventsrc.envelope.occupancy_map import OccupancyMap

from .exact import UnitVector

RunOrdinal = NewType("RunOrdinal", int)
KeyframeOrdinal = NewType("KeyframeOrdinal", int)
ObservationOrdinal = NewType("ObservationOrdinal", int)
PlaceOrdinal = NewType("PlaceOrdinal", int)
ObjectOrdinal = NewType("ObjectOrdinal", int)
SkipKind: TypeAlias = Literal[
    "duplicate", "conflict", "det_id_reused", "forgotten", "dropped", "scan_too_far"
]
"""Why an envelope, or an observation or scan of it, is left out of the map; see `EventSkipped`."""
FusibleObservation: TypeAlias = tuple[ObservationOrdinal, DetId, str, NDArray[np.float64], int]
"""Ordinal, det_id, class name, unit vector as of `exact.Units`, its squared norm."""


class Pose(msgspec.Struct, frozen=True, gc=False):
    """The robot's pose in the map frame: µm, and radians as they came."""

    x_um: int
    y_um: int
    yaw_rad: float

    @property
    def x_m(self) -> float:
        """Metres, correctly rounded."""
        return self.x_um / 1_000_000

    @property
    def y_m(self) -> float:
        """Metres, correctly rounded."""
        return self.y_um / 1_000_000


class RunSeen(msgspec.Struct, frozen=True, gc=False):
    """A run is new, or started earlier: ``started_at`` is its earliest timestamp so far."""

    offset: Offset
    run: RunOrdinal
    run_id: RunId
    started_at: float


class KeyframeAdded(msgspec.Struct, frozen=True, gc=False):
    """A new keyframe. ``pose``, ``floor``, the name of the one that the pose is on, and ``camera``,
    the one that took the picture, are None where the envelope has none. ``frame`` is what the
    envelope names, if that is not the map's own frame."""

    offset: Offset
    keyframe: KeyframeOrdinal
    run: RunOrdinal
    run_id: RunId
    keyframe_id: KeyframeId
    timestamp: float
    pose: Pose | None
    floor: str | None = None
    camera: StatedCamera | None = None
    frame: str | None = None


class FrameJoined(msgspec.Struct, frozen=True, gc=False):
    """Poses in a map frame are moved into another, None for the map's own, by a turn of ``dyaw``
    radians, then a shift in metres, as the command at offset ``command`` says."""

    offset: Offset
    frame: str
    into: str | None
    dx: float
    dy: float
    dyaw: float
    command: Offset


class Body(msgspec.Struct, frozen=True, gc=False):
    """The measured height of a thing's middle in the map frame, and its length, width and height,
    µm; None for what was not measured."""

    z_um: int | None
    length_um: int | None = None
    width_um: int | None = None
    height_um: int | None = None


class ObservationAdded(msgspec.Struct, frozen=True, eq=False, gc=False):
    """A new detection of a keyframe.

    ``embedding`` is None when the detection has none *or* it is of another space than the map's
    (then ``foreign_space`` is true). ``measured`` is whether it has a depth or a position.
    """

    offset: Offset
    observation: ObservationOrdinal
    keyframe: KeyframeOrdinal
    run_id: RunId
    keyframe_id: KeyframeId
    det_id: DetId
    class_name: str
    confidence: float
    bbox: tuple[float, float, float, float]
    embedding_model: str | None
    embedding: UnitVector | None
    foreign_space: bool
    measured: bool = False
    body: Body | None = None


class EventSkipped(msgspec.Struct, frozen=True, gc=False):
    """An envelope, or a detection or scan of it, that changes nothing.

    ``kind`` is ``duplicate`` (same keyframe, same content), ``conflict`` (other content: the first
    one stands), ``forgotten`` (a correction leaves the keyframe out), ``det_id_reused`` (an earlier
    keyframe has the ``det_id``), ``dropped`` (a correction leaves this one out) or ``scan_too_far``
    (`scans`). For these three the rest of the keyframe is folded.
    """

    offset: Offset
    kind: SkipKind
    run_id: RunId
    keyframe_id: KeyframeId
    det_id: DetId | None = None
    first_offset: Offset | None = None


class PlaceFormed(msgspec.Struct, frozen=True, gc=False):
    """A new place, founded by the keyframe ``founder``, its first core point; its id is
    ``{run_id}_p{counter}`` with a counter from 0 per founding run."""

    offset: Offset
    place: PlaceOrdinal
    place_id: str
    founder: KeyframeOrdinal


class PlaceLink(msgspec.Struct, frozen=True, gc=False):
    """Two core points within ε of each other that joined two places; keyframe ordinals, µm. By
    rooms: the founders of the cells that are the shortest drive apart, and its length."""

    core: KeyframeOrdinal
    neighbour: KeyframeOrdinal
    distance_um: int


class MeanDrive(msgspec.Struct, frozen=True, gc=False):
    """Why places by rooms became one: the mean driven distance, rounded down, between the ``cells``
    of the survivor and the ``absorbed_cells`` of the other."""

    mean_um: int
    cells: int
    absorbed_cells: int


class PlacesMerged(msgspec.Struct, frozen=True, gc=False):
    """Places became one. All members of ``absorbed`` belong to ``survivor`` from now on.

    No KeyframePlaced is emitted for them: code that keeps members must move them all. ``bridge`` is
    the keyframe whose arrival did it, ``links`` the pair of core points that joined each absorbed
    place. ``survivor_count`` and ``absorbed_counts`` are members before the merge. ``joined`` are
    absorbed by a ``join`` command; their link is of its two anchors, at whatever distance.
    ``drives`` are there for places by rooms, one for each absorbed place not in ``joined``.
    """

    offset: Offset
    survivor: PlaceOrdinal
    absorbed: tuple[PlaceOrdinal, ...]
    bridge: KeyframeOrdinal
    links: tuple[PlaceLink, ...]
    survivor_count: int
    absorbed_counts: tuple[int, ...]
    joined: tuple[PlaceOrdinal, ...] = ()
    drives: tuple[MeanDrive, ...] = ()


class MergeRefused(msgspec.Struct, frozen=True, gc=False):
    """Two places touched and stay two, because a correction keeps them apart.
    ``link`` is the pair of core points, or of a ``join``'s anchors, that would have joined them,
    ``bridge`` the keyframe whose arrival did it, ``apart`` the anchors that are kept apart, of
    ``a``, founded first, and of ``b``. A pair of places has only one.
    """

    offset: Offset
    a: PlaceOrdinal
    b: PlaceOrdinal
    bridge: KeyframeOrdinal
    link: PlaceLink
    apart: tuple[KeyframeOrdinal, KeyframeOrdinal]


class PlaceNamed(msgspec.Struct, frozen=True, gc=False):
    """A place has a name, or (None) has none any more; ``command`` is what gives it."""

    offset: Offset
    place: PlaceOrdinal
    name: str | None
    command: Offset | None = None


class KeyframePlaced(msgspec.Struct, frozen=True, gc=False):
    """A keyframe, new or noise until now, belongs to a place."""

    offset: Offset
    keyframe: KeyframeOrdinal
    place: PlaceOrdinal


class PlaceChanged(msgspec.Struct, frozen=True, gc=False):
    """A place's members changed: their number and the sums of their positions, in µm. The centroid
    in metres is ``sum / (keyframe_count * 1_000_000)``, correctly rounded."""

    offset: Offset
    place: PlaceOrdinal
    keyframe_count: int
    sum_x_um: int
    sum_y_um: int


class ObjectFound(msgspec.Struct, frozen=True, gc=False):
    """A new Object, founded by an observation; its position is that keyframe's pose."""

    offset: Offset
    object: ObjectOrdinal
    object_id: str
    class_name: str
    observation: ObservationOrdinal


class ObjectSeen(msgspec.Struct, frozen=True, gc=False):
    """An observation, also the founding one, was assigned to an Object; its new values.
    ``similarity_q40`` is the cosine with the Object's mean embedding before this observation, as an
    exact multiple of 2⁻⁴⁰ (2⁴⁰ for the founding one); by evidence that with the most similar look
    kept, None where there was no embedding to compare. The mean position in metres is
    ``sum / (obs_count * 1_000_000)``. ``first_seen`` and ``last_seen`` are robot timestamps.
    """

    offset: Offset
    object: ObjectOrdinal
    observation: ObservationOrdinal
    similarity_q40: int | None
    obs_count: int
    sum_x_um: int
    sum_y_um: int
    first_seen: float
    last_seen: float


class ObjectsMerged(msgspec.Struct, frozen=True, gc=False):
    """Two Objects became one; the survivor's new values.
    All observations of ``absorbed`` belong to ``survivor`` from now on. No ObjectSeen is emitted
    for them: code that keeps observations must move them all. ``evidence`` is None where a
    ``same-object`` command did it.
    """

    offset: Offset
    survivor: ObjectOrdinal
    absorbed: ObjectOrdinal
    obs_count: int
    sum_x_um: int
    sum_y_um: int
    first_seen: float
    last_seen: float
    evidence: "MergeEvidence | None" = None


class MergeEvidence(msgspec.Struct, frozen=True, gc=False):
    """Why fusion by evidence made two Objects one: log-likelihood ratios ``look`` and ``geometry``
    in thousandths of a nat, same thing against two. ``distance_um`` is of the estimates;
    ``pictures_with_both`` of ``pictures`` showed both."""

    look: int
    geometry: int
    distance_um: int
    pictures_with_both: int
    pictures: int


class ObjectEstimated(msgspec.Struct, frozen=True, gc=False):
    """An Object's position, estimated from the bearings of its observations; new values: µm, µm²,
    and the number of spots, 0.35 m apart, that it was seen from. Only by evidence."""

    offset: Offset
    object: ObjectOrdinal
    x_um: int
    y_um: int
    var_xx_um2: int
    var_xy_um2: int
    var_yy_um2: int
    spots: int


class ObjectClassified(msgspec.Struct, frozen=True, gc=False):
    """Most of an Object's observations are of this class now; ties go to the class seen first."""

    offset: Offset
    object: ObjectOrdinal
    class_name: str


class ObjectMissing(msgspec.Struct, frozen=True, gc=False):
    """An Object was not seen where it should have been; new values. ``misses`` counts the keyframes
    of the run that should show it and do not; ``missing`` is whether that makes it missing, False
    again once it is seen there."""

    offset: Offset
    object: ObjectOrdinal
    run: RunOrdinal
    misses: int
    missing: bool


class ObjectRelocated(msgspec.Struct, frozen=True, gc=False):
    """An Object was found elsewhere; its estimate, before and now, leaves out what came earlier."""

    offset: Offset
    object: ObjectOrdinal
    observation: ObservationOrdinal
    from_x_um: int
    from_y_um: int
    to_x_um: int
    to_y_um: int


class ObjectMoved(msgspec.Struct, frozen=True, gc=False):
    """An Object is located in another place than before, or in none (None)."""

    offset: Offset
    object: ObjectOrdinal
    place: PlaceOrdinal | None


class PlacesLinked(msgspec.Struct, frozen=True, gc=False):
    """The number of shared transitions of two places changed; ``a`` was founded before ``b``, and 0
    removes the edge: one of the two was absorbed, or relabelling moved the transitions."""

    offset: Offset
    a: PlaceOrdinal
    b: PlaceOrdinal
    shared_transitions: int


class MapGiven(msgspec.Struct, frozen=True, eq=False, gc=False):
    """An occupancy map holds from here on, by scans of keyframes or by an event that is a map."""

    offset: Offset
    map: OccupancyMap
    scanned: bool = False


Delta: TypeAlias = (
    RunSeen
    | FrameJoined
    | KeyframeAdded
    | ObservationAdded
    | EventSkipped
    | PlaceFormed
    | PlacesMerged
    | MergeRefused
    | KeyframePlaced
    | PlaceChanged
    | PlaceNamed
    | ObjectFound
    | ObjectSeen
    | ObjectsMerged
    | ObjectEstimated
    | ObjectClassified
    | ObjectMissing
    | ObjectRelocated
    | ObjectMoved
    | PlacesLinked
    | MapGiven
)
