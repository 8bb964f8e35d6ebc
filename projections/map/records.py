"""The records of a `MapView`: its runs, keyframes, observations, places and Objects, and what is in
each place.

Records are written by `MapView.apply` only. ``ordinal`` numbers the things of a kind in the order
in which the fold met or founded them. Positions are integer micrometres (``_um``) and exact; ``_m``
and ``_x``/``_y`` values are metres, correctly rounded. Times are robot seconds.
"""

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Any, Final, NamedTuple, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from eventsrc.base.text import counted
from eventsrc.envelope.model import DetId, KeyframeId, Offset, RunId, StatedCamera
from projections.fold import deltas
from projections.fold.deltas import ObservationOrdinal
from projections.fold.exact import UM_PER_M, UnitVector, mean_m
from projections.fold.pair_groups import PlaceSurvivors
from projections.fold.place_types import ONCE
from projections.fold.spots import SPOT_M

_UM2_PER_M2 = UM_PER_M * UM_PER_M


@dataclass(slots=True, eq=False)
class RunRecord:
    """One run. ``started_at`` is the earliest keyframe timestamp of it so far."""

    ordinal: deltas.RunOrdinal
    run_id: RunId
    started_at: float
    keyframe_count: int = 0


@dataclass(slots=True, eq=False)
class PlaceRecord:
    """A region of the building. ``founder`` is its first core keyframe; ``name`` the name that the
    command at ``name_offset`` gave it.

    `MapView.places` lists those that were not absorbed.
    """

    ordinal: deltas.PlaceOrdinal
    place_id: str
    founder: deltas.KeyframeOrdinal
    founded_offset: Offset
    keyframe_count: int = 0
    sum_x_um: int = 0
    sum_y_um: int = 0
    name: str | None = None
    name_offset: Offset | None = None
    unordered_members: list[deltas.KeyframeOrdinal] = field(default_factory=list)

    @property
    def members(self) -> list[deltas.KeyframeOrdinal]:
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


class KeyframeRecord(msgspec.Struct, eq=False, gc=False):
    """One keyframe. ``offset`` is its event's; ``pose`` is None when the robot had none.

    ``joined`` is the place it joined, as of then; ``survivors`` are the view's. ``floor`` is the
    name of the floor that the pose is on and ``camera`` the one that took the picture, where the
    log states them, and so is ``frame``, if that is not the map's own.
    """

    ordinal: deltas.KeyframeOrdinal
    offset: Offset
    run: deltas.RunOrdinal
    run_id: RunId
    keyframe_id: KeyframeId
    timestamp: float
    pose: deltas.Pose | None
    survivors: PlaceSurvivors
    observations: list[deltas.ObservationOrdinal] | tuple[()] = ()
    joined: deltas.PlaceOrdinal | None = None
    floor: str | None = None
    camera: StatedCamera | None = None
    frame: str | None = None

    @property
    def place(self) -> deltas.PlaceOrdinal | None:
        """The place it belongs to now; None for noise or without a pose."""
        return None if self.joined is None else self.survivors.find(self.joined)


class Poses(NamedTuple):
    """Poses as columns: ordinals of keyframes and runs, positions of shape (n, 2), and floors as
    indices into ``names``, their names."""

    keyframes: NDArray[np.int64]
    runs: NDArray[np.int64]
    positions_um: NDArray[np.int64]
    floors: NDArray[np.int64]
    names: Sequence[str | None]

    @classmethod
    def of(cls, keyframes: Iterable[KeyframeRecord]) -> Self:
        """Those of some keyframes, in the order in which their runs went."""
        posed = [(k.run, k.keyframe_id, k, k.pose) for k in keyframes if k.pose is not None]
        posed.sort(key=itemgetter(0, 1))
        names = dict.fromkeys(k.floor for _, _, k, _ in posed)
        number_of = {name: number for number, name in enumerate(names)}
        return cls(
            np.array([k.ordinal for _, _, k, _ in posed], np.int64),
            np.array([run for run, *_ in posed], np.int64),
            np.array([(at.x_um, at.y_um) for *_, at in posed], np.int64).reshape(-1, 2),
            np.array([number_of[k.floor] for _, _, k, _ in posed], np.int64),
            list(names),
        )


class ObservationRecord(msgspec.Struct, eq=False, gc=False):
    """One detection. ``object`` is None when it was not fused, ``similarity_q40`` also where there
    was nothing to compare (`ObjectSeen`).

    ``embedding`` is None when there is none, when it is of a foreign space, or when the view was
    made with ``keep_embeddings=False``; ``embedding_crc`` is there even then. ``measured`` is
    whether it has a depth or a position, ``body`` its measured height and size.
    """

    ordinal: deltas.ObservationOrdinal
    keyframe: deltas.KeyframeOrdinal
    det_id: DetId
    class_name: str
    confidence: float
    bbox: tuple[float, float, float, float]
    embedding_model: str | None
    embedding: UnitVector | None
    embedding_crc: int | None
    foreign_space: bool
    object: deltas.ObjectOrdinal | None = None
    similarity_q40: int | None = None
    measured: bool = False
    body: deltas.Body | None = None


@dataclass(frozen=True, slots=True)
class EstimatedPosition:
    """An Object's estimated position with its covariance in µm²; it was seen from ``spots``
    spots."""

    x_um: int
    y_um: int
    var_xx_um2: int
    var_xy_um2: int
    var_yy_um2: int
    spots: int

    @property
    def est_x(self) -> float:
        """Metres."""
        return self.x_um / UM_PER_M

    @property
    def est_y(self) -> float:
        """Metres."""
        return self.y_um / UM_PER_M

    @property
    def covariance_m2(self) -> tuple[float, float, float]:
        """Its xx, xy and yy in m²."""
        return (
            self.var_xx_um2 / _UM2_PER_M2,
            self.var_xy_um2 / _UM2_PER_M2,
            self.var_yy_um2 / _UM2_PER_M2,
        )

    @property
    def est_sigma_m(self) -> float:
        """Metres; the standard error in the direction in which it is largest."""
        half = (self.var_xx_um2 + self.var_yy_um2) / 2
        apart = (self.var_xx_um2 - self.var_yy_um2) / 2
        return math.sqrt(half + math.sqrt(apart * apart + self.var_xy_um2**2)) / UM_PER_M


@dataclass(frozen=True, slots=True)
class Relocation:
    """An Object was found at another position by ``observation``, of the event at ``offset``."""

    offset: Offset
    observation: deltas.ObservationOrdinal
    from_x_um: int
    from_y_um: int
    to_x_um: int
    to_y_um: int


@dataclass(slots=True, eq=False)
class ObjectRecord:
    """A landmark. ``observations`` are ordinals in the order in which they were fused.

    `MapView.objects` lists those that were not absorbed. The fields after ``observations`` are
    those of fusion by evidence: ``misses`` is the number of keyframes of a run that should show it
    and do not, ``missing_in`` the run by which it is missing. ``confirmed`` is as in
    `projections.map.records`, ``counted_as`` how `PlaceContents` counts it.
    """

    ordinal: deltas.ObjectOrdinal
    object_id: str
    class_name: str
    obs_count: int = 0
    sum_x_um: int = 0
    sum_y_um: int = 0
    first_seen: float = 0.0
    last_seen: float = 0.0
    place: deltas.PlaceOrdinal | None = None
    observations: list[deltas.ObservationOrdinal] = field(default_factory=list)
    estimate: EstimatedPosition | None = None
    misses: int = 0
    missing_in: deltas.RunOrdinal | None = None
    relocations: list[Relocation] = field(default_factory=list)
    confirmed: bool = False
    counted_as: tuple[deltas.PlaceOrdinal, str, bool] | None = None

    def recount(self, delta: deltas.ObjectSeen | deltas.ObjectsMerged) -> None:
        """Take over the count, sums and times of a delta."""
        self.obs_count = delta.obs_count
        self.sum_x_um, self.sum_y_um = delta.sum_x_um, delta.sum_y_um
        self.first_seen, self.last_seen = delta.first_seen, delta.last_seen

    @property
    def spot(self) -> tuple[float, float]:
        """The estimated position in metres; without an estimate `mean_x` and `mean_y`."""
        at = self.estimate
        return (self.mean_x, self.mean_y) if at is None else (at.est_x, at.est_y)

    @property
    def mean_x(self) -> float:
        """Metres; the mean of the positions the robot observed it from."""
        return mean_m(self.sum_x_um, self.obs_count)

    @property
    def mean_y(self) -> float:
        """Metres; the mean of the positions the robot observed it from."""
        return mean_m(self.sum_y_um, self.obs_count)


def measured_body(
    found: ObjectRecord, observations: Sequence[ObservationRecord]
) -> deltas.Body | None:
    """The medians of the heights and sizes that the Object's observations have, of an even number
    the lower one; None without any. Its height is that of the observations since it was found
    elsewhere."""
    since = found.relocations[-1].observation if found.relocations else 0
    seen = [(o, e) for o in found.observations if (e := observations[o].body) is not None]
    heights = [e.z_um for o, e in seen if o >= since and e.z_um is not None]
    sizes = [[part for _, e in seen if (part := getattr(e, name)) is not None] for name in _SIZE]
    medians = [sorted(each)[(len(each) - 1) // 2] if each else None for each in (heights, *sizes)]
    return None if medians == [None] * 4 else deltas.Body(*medians)


def body_fields(body: deltas.Body | None) -> dict[str, Any]:
    """``z``, and ``size`` as length, width and height, metres, where they are known."""
    if body is None:
        return {}
    fields: dict[str, Any] = {}
    if body.z_um is not None:
        fields["z"] = body.z_um / UM_PER_M
    parts = [getattr(body, name) for name in _SIZE]
    if None not in parts:
        fields["size"] = [part / UM_PER_M for part in parts]
    return fields


_SIZE: Final = ("length_um", "width_um", "height_um")


class PlaceContents:
    """Counts of Objects by place and class; `update` is to be called after every change of an
    Object. One that was observed once is counted apart (`place_types.ONCE`). ``touched`` are the
    places whose counts have changed since it was emptied last."""

    def __init__(self) -> None:
        # place → class → Objects observed once, and more often
        self._counts: dict[deltas.PlaceOrdinal, dict[str, list[int]]] = {}
        self.touched: set[deltas.PlaceOrdinal] = set()

    def update(self, found: ObjectRecord) -> None:
        """Replace the Object's earlier count by its current one."""
        place = found.place
        now = None if place is None else (place, found.class_name, found.obs_count > 1)
        before = found.counted_as
        if now == before:
            return
        found.counted_as = now
        for key, change in ((before, -1), (now, 1)):
            if key is not None:
                in_place = self._counts.setdefault(key[0], {})
                in_place.setdefault(key[1], [0, 0])[key[2]] += change
                self.touched.add(key[0])

    def of(self, place: deltas.PlaceOrdinal) -> Mapping[str, float]:
        """The weight of each class in a place."""
        counts = self._counts.get(place, {})
        return {name: often + ONCE * once for name, (once, often) in counts.items()}


APART_UM: Final = round(SPOT_M * UM_PER_M)
APART_S: Final = 60.0


def confirm(
    found: ObjectRecord,
    new: Iterable[ObservationOrdinal],
    observations: list[ObservationRecord],
    keyframes: list[KeyframeRecord],
) -> None:
    """Set whether an Object is confirmed, after ``new`` have become observations of it."""
    if found.confirmed:
        return
    first = keyframes[observations[found.observations[0]].keyframe]
    found.confirmed = any(
        seen.measured or _is_apart(first, keyframes[seen.keyframe])
        for seen in map(observations.__getitem__, new)
    )


def objects_text(objects: Collection[ObjectRecord]) -> str:
    """``142 objects + 695 seen once``: those that are confirmed, and the others."""
    return counts_text(len(objects), seen_once(objects))


def seen_once(objects: Iterable[ObjectRecord]) -> int:
    """The number of those that are not confirmed."""
    return sum(not found.confirmed for found in objects)


def counts_text(objects: int, once: int) -> str:
    """`objects_text` for this many Objects, ``once`` of them seen once."""
    return counted(objects - once, "object") + (f" + {once:,} seen once" if once else "")


def _is_apart(first: KeyframeRecord, later: KeyframeRecord) -> bool:
    if first.run != later.run or abs(later.timestamp - first.timestamp) > APART_S:
        return True
    if first.pose is None or later.pose is None:
        return False
    dx, dy = later.pose.x_um - first.pose.x_um, later.pose.y_um - first.pose.y_um
    return dx * dx + dy * dy >= APART_UM * APART_UM
