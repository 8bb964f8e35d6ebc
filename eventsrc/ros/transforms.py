"""The tree of ROS frames over time: transforms of /tf and /tf_static, interpolated at a stamp.

A transform is the pose of a child frame in its parent: x, y, z in metres and a unit quaternion.
Between two samples of a link the position is interpolated linearly and the rotation by slerp, as
tf2 does; before the first and after the last sample there is no result. Samples may come in any
order. Unlike tf2, two samples farther apart than ``max_gap_ns`` are not interpolated, and memory is
bounded by a number of samples, not by time, so that a stamp in the far future removes no samples.
"""

import math
from bisect import bisect_left, bisect_right
from dataclasses import dataclass, field
from typing import Final, Generic, NamedTuple, TypeVar

from eventsrc.envelope.model import MAX_POSITION_M

MAX_SAMPLES: Final = 200_000
"""Samples that a buffer keeps. When there are more, the older half of each link is deleted."""
MAX_FRAMES: Final = 2_000
_MAX_DEPTH: Final = 100
"""Bound of the links from a frame up to the root; more is a cycle."""
_NORM_TOLERANCE: Final = 0.01
_PARALLEL: Final = 0.9999995
"""Cosine of half the angle above which slerp and linear interpolation are the same to 1e-10."""

Value = TypeVar("Value")


class Transform(NamedTuple):
    """A pose in another frame: metres and a unit quaternion."""

    x: float
    y: float
    z: float
    qx: float
    qy: float
    qz: float
    qw: float


IDENTITY: Final = Transform(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


class BadTransform(ValueError):
    """An invalid pose: not finite, out of bounds, or without a unit quaternion."""


def unit_transform(
    x: float, y: float, z: float, qx: float, qy: float, qz: float, qw: float
) -> Transform:
    """A transform with its quaternion normalised. Raises BadTransform if its length is not near 1,
    or the position is out of bounds."""
    norm = math.sqrt(qx * qx + qy * qy + qz * qz + qw * qw)
    if not abs(norm - 1.0) <= _NORM_TOLERANCE:
        raise BadTransform(f"the rotation ({qx:g}, {qy:g}, {qz:g}, {qw:g}) is no unit quaternion")
    if not (abs(x) <= MAX_POSITION_M and abs(y) <= MAX_POSITION_M and abs(z) <= MAX_POSITION_M):
        raise BadTransform(f"the position ({x:g}, {y:g}, {z:g}) is not within 10,000 km")
    return Transform(x, y, z, qx / norm, qy / norm, qz / norm, qw / norm)


def rotate(t: Transform, x: float, y: float, z: float) -> tuple[float, float, float]:
    """The vector (x, y, z) turned by the rotation of ``t``."""
    _, _, _, qx, qy, qz, qw = t
    # v + 2 q × (q × v + w v)
    ax = qy * z - qz * y + qw * x
    ay = qz * x - qx * z + qw * y
    az = qx * y - qy * x + qw * z
    return (
        x + 2.0 * (qy * az - qz * ay),
        y + 2.0 * (qz * ax - qx * az),
        z + 2.0 * (qx * ay - qy * ax),
    )


def compose(a: Transform, b: Transform) -> Transform:
    """The product ``a`` · ``b``: a pose ``b`` in the child frame of ``a``, in the parent frame."""
    dx, dy, dz = rotate(a, b.x, b.y, b.z)
    _, _, _, ax, ay, az, aw = a
    _, _, _, bx, by, bz, bw = b
    return Transform(
        a.x + dx,
        a.y + dy,
        a.z + dz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def invert(t: Transform) -> Transform:
    """The inverse: the parent's pose in the child frame."""
    turned_back = Transform(0.0, 0.0, 0.0, -t.qx, -t.qy, -t.qz, t.qw)
    x, y, z = rotate(turned_back, -t.x, -t.y, -t.z)
    return Transform(x, y, z, -t.qx, -t.qy, -t.qz, t.qw)


def interpolate(a: Transform, b: Transform, share: float) -> Transform:
    """Between ``a`` (share 0) and ``b`` (share 1): linear, and slerp by the shorter way."""
    dot = a.qx * b.qx + a.qy * b.qy + a.qz * b.qz + a.qw * b.qw
    sign = -1.0 if dot < 0.0 else 1.0
    dot = abs(dot)
    if dot > _PARALLEL:
        wa, wb = 1.0 - share, share * sign
    else:
        angle = math.acos(dot)
        sine = math.sin(angle)
        wa = math.sin((1.0 - share) * angle) / sine
        wb = math.sin(share * angle) / sine * sign
    qx, qy = wa * a.qx + wb * b.qx, wa * a.qy + wb * b.qy
    qz, qw = wa * a.qz + wb * b.qz, wa * a.qw + wb * b.qw
    norm = math.sqrt(qx * qx + qy * qy + qz * qz + qw * qw)
    return Transform(
        a.x + share * (b.x - a.x),
        a.y + share * (b.y - a.y),
        a.z + share * (b.z - a.z),
        qx / norm,
        qy / norm,
        qz / norm,
        qw / norm,
    )


class TimeSeries(Generic[Value]):
    """Values by stamp, kept in ascending order; they may be added in any order."""

    __slots__ = ("stamps", "values")

    def __init__(self) -> None:
        self.stamps: list[int] = []
        self.values: list[Value] = []

    def add(self, stamp_ns: int, value: Value) -> bool:
        """Add a value; return False, without a change, if the stamp has one already."""
        stamps = self.stamps
        if not stamps or stamp_ns > stamps[-1]:
            stamps.append(stamp_ns)
            self.values.append(value)
            return True
        at = bisect_left(stamps, stamp_ns)
        if stamps[at] == stamp_ns:
            return False
        stamps.insert(at, stamp_ns)
        self.values.insert(at, value)
        return True

    def around(self, stamp_ns: int, max_gap_ns: int) -> tuple[Value, Value, float] | None:
        """The values before and after a stamp, and the share, 0 to 1, of the time between them that
        has passed at the stamp. None if one is missing or they are more than ``max_gap_ns`` apart.
        """
        stamps = self.stamps
        after = bisect_left(stamps, stamp_ns)
        if after == len(stamps):
            return None
        later = stamps[after]
        if later == stamp_ns:
            return self.values[after], self.values[after], 0.0
        if after == 0:
            return None
        earlier = stamps[after - 1]
        if later - earlier > max_gap_ns:
            return None
        share = (stamp_ns - earlier) / (later - earlier)
        return self.values[after - 1], self.values[after], share

    def latest(self, stamp_ns: int) -> Value | None:
        """The last value at or before a stamp."""
        at = bisect_right(self.stamps, stamp_ns)
        return self.values[at - 1] if at else None

    def forget_half(self) -> int:
        """Drop the older half; return the number of dropped values."""
        half = len(self.stamps) // 2
        del self.stamps[:half]
        del self.values[:half]
        return half


@dataclass(slots=True)
class _Link:
    """A child's poses in ``parent``: one for all times if it is static, else samples by stamp."""

    parent: str
    static: Transform | None = None
    moving: "TimeSeries[Transform]" = field(default_factory=lambda: TimeSeries())

    def at(self, stamp_ns: int, max_gap_ns: int) -> Transform | None:
        if self.static is not None:
            return self.static
        around = self.moving.around(stamp_ns, max_gap_ns)
        return None if around is None else interpolate(*around)


def _merged(links: list[_Link]) -> list[_Link]:
    """The same path with consecutive static links composed into one; the first is the lowest."""
    merged: list[_Link] = []
    for link in links:
        below = merged[-1].static if merged else None
        if link.static is None or below is None:
            merged.append(link)
        else:
            merged[-1] = _Link(link.parent, compose(link.static, below))
    return merged


class TransformBuffer:
    """Links by child frame. A static link stands for all times and is not replaced by a moving
    one; when a child gets another parent, its samples under the first are deleted."""

    def __init__(self, max_gap_ns: int, max_samples: int = MAX_SAMPLES) -> None:
        self._max_gap_ns = max_gap_ns
        self._max_samples = max_samples
        self._links: dict[str, _Link] = {}
        self._samples = 0
        self._paths: dict[tuple[str, str], tuple[list[_Link], list[_Link]] | None] = {}
        self.ignored = 0
        """Number of samples not kept: of a frame in itself, of more than MAX_FRAMES frames, older
        than a change of parent, or moving ones of a static child."""

    def add(self, parent: str, child: str, stamp_ns: int, pose: Transform) -> None:
        """Add a sample of a moving link. Of two with the same stamp the first is kept."""
        link = self._link(parent, child)
        if link is None or link.static is not None:
            self.ignored += 1
            return
        if link.parent != parent:
            stamps = link.moving.stamps
            if stamps and stamp_ns < stamps[-1]:
                self.ignored += 1
                return
            self._samples -= len(stamps)
            link.parent, link.moving = parent, TimeSeries()
            self._paths.clear()
        self._samples += link.moving.add(stamp_ns, pose)
        if self._samples > self._max_samples:
            self._forget()

    def add_static(self, parent: str, child: str, pose: Transform) -> None:
        """Add a link for all times, in place of an earlier one of the child."""
        link = self._link(parent, child)
        if link is None:
            self.ignored += 1
            return
        self._samples -= len(link.moving.stamps)
        self._links[child] = _Link(parent, pose)
        self._paths.clear()

    def lookup(self, target: str, source: str, stamp_ns: int) -> Transform | None:
        """The pose of ``source`` in ``target``; None while a link is missing or has no samples
        around the stamp."""
        if target == source:
            return IDENTITY
        path = self._path(target, source)
        if path is None:
            return None
        up, down = path
        there = self._chain(up, stamp_ns)
        if there is None or not down:
            return there
        back = self._chain(down, stamp_ns)
        return None if back is None else compose(invert(back), there)

    def is_connected(self, target: str, source: str) -> bool:
        """Whether links join the two frames at any time."""
        return target == source or self._path(target, source) is not None

    def above(self, frame: str) -> list[str]:
        """The frame and all its ancestors, from below; empty for a cycle."""
        return [name for name, _ in self._upwards(frame)]

    def frames(self) -> set[str]:
        """All parents and children of links."""
        return {name for child, link in self._links.items() for name in (child, link.parent)}

    def _link(self, parent: str, child: str) -> _Link | None:
        """The child's link, added if there is none; None if it is not allowed."""
        if parent == child or not parent or not child:
            return None
        link = self._links.get(child)
        if link is None:
            if len(self._links) >= MAX_FRAMES:
                return None
            link = self._links[child] = _Link(parent)
            self._paths.clear()
        return link

    def _path(self, target: str, source: str) -> tuple[list[_Link], list[_Link]] | None:
        """Links from the source and from the target up to their lowest common ancestor."""
        key = target, source
        if key not in self._paths:
            if len(self._paths) > MAX_FRAMES:
                self._paths.clear()
            self._paths[key] = self._find_path(target, source)
        return self._paths[key]

    def _find_path(self, target: str, source: str) -> tuple[list[_Link], list[_Link]] | None:
        above: dict[str, list[_Link]] = {}
        down: list[_Link] = []
        for frame, link in self._upwards(target):
            above[frame] = [*down]
            if link is not None:
                down.append(link)
        up: list[_Link] = []
        for frame, link in self._upwards(source):
            if frame in above:
                return _merged(up), _merged(above[frame])
            if link is not None:
                up.append(link)
        return None

    def _upwards(self, frame: str) -> list[tuple[str, _Link | None]]:
        """A frame and its ancestors, each with its link, None for the root; empty for a cycle."""
        way: list[tuple[str, _Link | None]] = []
        while len(way) < _MAX_DEPTH:
            link = self._links.get(frame)
            way.append((frame, link))
            if link is None:
                return way
            frame = link.parent
        return []

    def _chain(self, links: list[_Link], stamp_ns: int) -> Transform | None:
        """The pose of the lowest child of a chain in its highest parent."""
        whole: Transform | None = None
        for link in links:
            pose = link.at(stamp_ns, self._max_gap_ns)
            if pose is None:
                return None
            whole = pose if whole is None else compose(pose, whole)
        return IDENTITY if whole is None else whole

    def _forget(self) -> None:
        for link in self._links.values():
            self._samples -= link.moving.forget_half()
