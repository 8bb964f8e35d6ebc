"""Corrected poses of one run: the result of its ``correct-poses`` commands for a keyframe or for
many at once, and the order in which they are in a fingerprint.

The work for a keyframe grows with the commands that move it after the last one that states its
pose, and the order is found in time that grows with n·log n of the commands and stated poses.
Nothing is rounded in another way than by applying the commands one after another.
"""

import heapq
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator, Sequence, Set
from functools import cached_property
from typing import Final, NamedTuple, TypeAlias

import numpy as np

from eventsrc.envelope.commands import CorrectPoses, RigidTransform
from eventsrc.envelope.model import KeyframeId

Pose: TypeAlias = tuple[float, float, float]
"""Metres, metres, radians."""

_LEAST, _MOST = -(2**63), 2**63 - 1
"""Bounds of keyframe ids."""
_BUCKET_BITS: Final = 8
_MANY: Final = 64
"""From so many transforms on, many keyframes are corrected at once."""


def moved_by(transform: RigidTransform, pose: Pose) -> Pose:
    """The pose after a transform."""
    t, (x, y, yaw) = transform, pose
    return (t.cos * x - t.sin * y + t.dx, t.sin * x + t.cos * y + t.dy, yaw + t.dyaw)


class PoseCorrection(NamedTuple):
    """One command's correction of a run's poses: ``poses`` by keyframe, or ``transform`` of the
    keyframes from ``first`` to ``last``, None for no bound."""

    poses: dict[KeyframeId, Pose]
    transform: RigidTransform | None
    first: KeyframeId | None
    last: KeyframeId | None

    @classmethod
    def of(cls, command: CorrectPoses) -> "PoseCorrection":
        """The correction by a command."""
        poses = {p.keyframe_id: (p.x, p.y, p.yaw) for p in command.poses}
        return cls(poses, command.transform, command.first, command.last)

    @property
    def span(self) -> tuple[int, int]:
        """The first and the last keyframe id that a transform moves."""
        first, last = self.first, self.last
        return _LEAST if first is None else first, _MOST if last is None else last

    def corrected(self, keyframe_id: KeyframeId, pose: Pose | None) -> Pose | None:
        """A keyframe's pose after this; a transform gives none to one that has none."""
        return self.poses.get(keyframe_id) if pose is None else self.apply(keyframe_id, pose)

    def apply(self, keyframe_id: KeyframeId, pose: Pose) -> Pose:
        """A keyframe's corrected pose: metres, metres, radians."""
        if self.transform is None:
            return self.poses.get(keyframe_id, pose)
        if self.first is not None and keyframe_id < self.first:
            return pose
        if self.last is not None and keyframe_id > self.last:
            return pose
        return moved_by(self.transform, pose)


class PoseCorrections(tuple[PoseCorrection, ...]):
    """The corrections of one run, in the order in which they apply."""

    @cached_property
    def _stated(self) -> dict[KeyframeId, tuple[int, Pose]]:
        """The last pose that a command states for a keyframe, and the number of that command."""
        return {
            keyframe_id: (number, pose)
            for number, correction in enumerate(self)
            for keyframe_id, pose in correction.poses.items()
        }

    @cached_property
    def _transforms(self) -> "_Transforms":
        return _Transforms(self)

    @property
    def are_many(self) -> bool:
        """Whether `corrected_poses` of many keyframes is quicker than `corrected` of each."""
        return len(self._transforms.numbers) >= _MANY

    def corrected(self, keyframe_id: KeyframeId, pose: Pose | None) -> Pose | None:
        """A keyframe's pose after all corrections; None if it has none."""
        number, pose = self._stated.get(keyframe_id, (-1, pose))
        if pose is None:
            return None
        x, y, yaw = pose
        for cos, sin, dx, dy, dyaw in self._transforms.of(keyframe_id, number):
            x, y, yaw = cos * x - sin * y + dx, sin * x + cos * y + dy, yaw + dyaw
        return x, y, yaw

    def corrected_poses(
        self, logged: Sequence[tuple[KeyframeId, Pose | None]]
    ) -> list[Pose | None]:
        """`corrected` of each, the transforms applied to all of them together."""
        order = sorted(range(len(logged)), key=lambda n: logged[n][0])
        ids = np.array([logged[n][0] for n in order], np.int64)
        stated = [self._stated.get(logged[n][0], (-1, logged[n][1])) for n in order]
        rows = [pose or (np.nan,) * 3 for _, pose in stated]
        xyw = np.array(rows, np.float64).reshape(-1, 3)
        x, y, yaw = xyw.T.copy()
        # A keyframe is moved only by what comes after the command that states its pose.
        waiting: dict[int, list[int]] = {}
        for at, (number, _) in enumerate(stated):
            if number >= 0:
                waiting.setdefault(number, []).append(at)
        given = sorted(waiting.items(), reverse=True)
        transforms = self._transforms
        begins = np.searchsorted(ids, transforms.first, "left").tolist()
        ends = np.searchsorted(ids, transforms.last, "right").tolist()
        with np.errstate(all="ignore"):  # out of bounds is for the caller to see
            for number, begin, end, (cos, sin, dx, dy, dyaw) in zip(
                transforms.numbers, begins, ends, transforms.rows, strict=True
            ):
                if begin >= end:
                    continue
                while given and given[-1][0] < number:
                    ats = given.pop()[1]
                    x[ats], y[ats], yaw[ats] = xyw[ats].T
                xs, ys = x[begin:end], y[begin:end]
                moved = cos * xs - sin * ys + dx
                y[begin:end] = sin * xs + cos * ys + dy
                x[begin:end] = moved
                yaw[begin:end] += dyaw
        for _, ats in given:
            x[ats], y[ats], yaw[ats] = xyw[ats].T
        found: list[Pose | None] = [None] * len(logged)
        for n, (_, pose), each in zip(
            order, stated, zip(x.tolist(), y.tolist(), yaw.tolist(), strict=True), strict=True
        ):
            found[n] = None if pose is None else each
        return found

    @cached_property
    def normal_order(self) -> list[object]:
        """The rows of the corrections, in an order that is the same for all orders with equal
        results.

        Two that have no keyframe in common can change places. So of those that need not come after
        one that is left, the one with the smallest row is next.
        """
        heads = [(_row(correction), n) for n, correction in enumerate(self)]
        after: list[list[int]] = [[] for _ in heads]
        waits = [0] * len(heads)
        for n, earlier in enumerate(_directly_before(self)):
            waits[n] = len(earlier)
            for each in earlier:
                after[each].append(n)
        ready = [heads[n] for n, number in enumerate(waits) if not number]
        heapq.heapify(ready)
        ordered = list[object]()
        while ready:
            row, n = heapq.heappop(ready)
            ordered.append(row)
            for later in after[n]:
                waits[later] -= 1
                if not waits[later]:
                    heapq.heappush(ready, heads[later])
        return ordered


class _Transforms:
    """The transforms among corrections: their numbers among these, the first and the last keyframe
    id that each moves, and their values."""

    def __init__(self, corrections: Iterable[PoseCorrection]) -> None:
        found = [
            (number, each, each.transform)
            for number, each in enumerate(corrections)
            if each.transform is not None
        ]
        self.numbers = [number for number, _, _ in found]
        spans = np.array([each.span for _, each, _ in found], np.int64).reshape(-1, 2)
        self.first, self.last = spans.T.copy()
        self.rows = [(t.cos, t.sin, t.dx, t.dy, t.dyaw) for _, _, t in found]

    def of(
        self, keyframe_id: KeyframeId, after: int
    ) -> Iterator[tuple[float, float, float, float, float]]:
        """The values of the transforms that move a keyframe, of those after a correction."""
        start = bisect_right(self.numbers, after)
        covers = (self.first[start:] <= keyframe_id) & (keyframe_id <= self.last[start:])
        return map(self.rows.__getitem__, (np.flatnonzero(covers) + start).tolist())


def _row(correction: PoseCorrection) -> tuple[object, ...]:
    """All of a correction, in values that have an order. An empty tuple stands for none."""
    bounds = [() if bound is None else (bound,) for bound in (correction.first, correction.last)]
    t = correction.transform
    numbers = () if t is None else (t.dx, t.dy, t.dyaw, t.cos, t.sin)
    return sorted(correction.poses.items()), numbers, *bounds


def _directly_before(corrections: Iterable[PoseCorrection]) -> Iterator[set[int]]:
    """For each correction the numbers of earlier ones that it must follow; those that these follow
    may be left out.

    For each keyframe id the last correction that reaches it is known: that of a transform by
    stretches of ids, of stated poses one by one. A correction follows those that are last where it
    reaches, and is the last there then. So each is met about as often as it was entered.
    """
    transforms, stated = _Stretches(), _Stated()
    for number, correction in enumerate(corrections):
        if correction.transform is None:
            earlier = transforms.at(correction.poses) | stated.put(correction.poses.keys(), number)
        else:
            first, last = correction.span
            earlier = transforms.put(first, last, number) | stated.take(first, last)
        yield {each for each in earlier if each is not None}


class _Stretches:
    """The last transform that reaches an id, by stretches of ids: from each of ``_starts`` to
    before the next one."""

    def __init__(self) -> None:
        self._starts: list[int] = [_LEAST]
        self._last: list[int | None] = [None]

    def at(self, keyframe_ids: Iterable[int]) -> set[int | None]:
        """The last transforms at some ids."""
        starts, last = self._starts, self._last
        if len(starts) == 1:
            return set(last)
        return {last[bisect_right(starts, keyframe_id) - 1] for keyframe_id in keyframe_ids}

    def put(self, first: int, last: int, number: int) -> set[int | None]:
        """Make ``number`` the last from ``first`` to ``last``; returns those that were."""
        starts, lasts, after = self._starts, self._last, last + 1
        begin, end = bisect_left(starts, first), bisect_left(starts, after)
        is_cut = begin == len(starts) or starts[begin] != first
        before = set(lasts[begin - is_cut : end])
        if end == len(starts) or starts[end] != after:  # the rest of a stretch begins there
            starts[begin:end], lasts[begin:end] = [first, after], [number, lasts[end - 1]]
        else:
            starts[begin:end], lasts[begin:end] = [first], [number]
        return before


class _Stated:
    """The last correction that states the pose of an id, where no transform came after it; in
    buckets of neighbouring ids."""

    def __init__(self) -> None:
        self._last: dict[int, int] = {}
        self._buckets: dict[int, set[int]] = {}

    def put(self, keyframe_ids: Set[int], number: int) -> set[int | None]:
        """Make ``number`` the last at some ids; returns those that were."""
        before = set(map(self._last.get, keyframe_ids))
        if None in before:
            for new in keyframe_ids - self._last.keys():
                self._buckets.setdefault(new >> _BUCKET_BITS, set()).add(new)
        self._last.update(dict.fromkeys(keyframe_ids, number))
        return before

    def take(self, first: int, last: int) -> set[int | None]:
        """Remove the ids from ``first`` to ``last``; returns the corrections that were the last."""
        if not self._last:
            return set()
        near = range(first >> _BUCKET_BITS, (last >> _BUCKET_BITS) + 1)
        buckets: Iterable[int] = near
        if len(near) > len(self._buckets):
            buckets = [bucket for bucket in self._buckets if bucket in near]
        taken: set[int | None] = set()
        for bucket in buckets:
            ids = self._buckets.get(bucket, set())
            inside = {keyframe_id for keyframe_id in ids if first <= keyframe_id <= last}
            ids -= inside
            if not ids:
                self._buckets.pop(bucket, None)
            taken |= {self._last.pop(keyframe_id) for keyframe_id in inside}
        return taken
