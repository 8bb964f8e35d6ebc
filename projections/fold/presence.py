"""Presence: detect Objects that are not seen where they should be.

A keyframe *looks for* an Object when its pose is in a cell of the grid next to a pose that the
Object was seen from, along a similar line of sight and from a similar distance, and the Object's
estimate lies well inside the picture. A look is a *hit* or a *miss*. Hits and misses include the
effects of walls, furniture and the detector: they are the rate at which a thing is seen from there.
An obstacle hides a thing from all poses nearby, so of one run and one cell of the grid the first
miss counts whole, the second half, others not; so do hits.

An Object's *odds* are the likelihood ratio of a run's looks: that it is still there over that it is
gone. In its home run, the one that found it, it is there. In another run every miss multiplies them
by its share of misses so far (of `_PRIOR` looks at the map's rate and its own), one that counts
half by the root of it, and every sighting by `_SEEN`, within bounds: sightings of another thing in
its place are assigned to it now and then, so one sighting does not outweigh many misses. A new run
starts with the odds of the last one, or with 1 if the Object was surely there.

It is *missing* when the odds fall below `_MISSING` with `_LEAST_MISSES` misses in the run, and no
longer when they rise above that.

Distances are metres in float64; with +, −, ×, ÷, √ only, in one order, so everything is bit-exact.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from eventsrc.envelope.model import Offset

from . import State
from . import deltas as d
from .exact import cos_sin
from .settings import CameraConstants
from .sights import half_field

_CELL_UM = 750_000
_NEAR_M2 = 1.1 * 1.1
_ROUNDING_M = 1e-3
_LEAST_AHEAD_M = 0.3
_INNER = 0.84
"""The inner share of half the picture's width within which an Object should be seen."""
_DISTANCES2 = 1.6 * 1.6
"""Square of the ratio of two distances up to which they are similar."""
_TURN2 = 0.87 * 0.87
"""Square of the least cosine between similar lines of sight, 30°."""
_PRIOR = 8.0
_WEIGHTS = 2, 1, 0
"""Weights of the first, the second and each other look from one cell in one run, in halves of a
look."""
_SEEN, _SURE, _FLOOR = 8.0, 512.0, 1.0 / 1024.0
_MISSING = 0.1
_LEAST_MISSES, _LEAST_HITS = 2, 2
Metres = tuple[float, float]
"""A position."""
_Cell = tuple[int, int]


@dataclass(slots=True, eq=False)
class Attendance:
    """The record of one Object. ``hits`` and ``misses`` are those of all looks while it was not
    missing, in halves; ``odds`` and ``run_misses`` (keyframes) those of ``run``, the last run that
    saw or missed it. ``confirmed`` is the last run before ``run`` in which it surely was there,
    ``seen`` the last that saw it. ``estimate`` is its position, metres, and the entries xx, xy, yy
    of the covariance, m². ``looks`` are hits and misses by cell in ``looks_run``."""

    home: d.RunOrdinal
    run: d.RunOrdinal
    confirmed: d.RunOrdinal
    seen: d.RunOrdinal
    looks_run: d.RunOrdinal
    estimate: tuple[float, ...] = (0.0,) * 5
    hits: int = 0
    misses: int = 0
    odds: float = 1.0
    run_misses: int = 0
    is_missing: bool = False
    looks: dict[_Cell, list[int]] = field(default_factory=dict)
    cells: set[_Cell] = field(default_factory=set)

    def weight(self, run: d.RunOrdinal, cell: _Cell, is_hit: bool) -> int:
        """Count a look from a cell and return its weight, in halves of a look."""
        if run != self.looks_run:
            self.looks_run = run
            self.looks.clear()
        counts = self.looks.setdefault(cell, [0, 0])
        before = counts[is_hit]
        if before < len(_WEIGHTS) - 1:
            counts[is_hit] = before + 1
        return _WEIGHTS[before]

    def enter(self, run: d.RunOrdinal) -> None:
        """Begin a run, unless it is the current one. Odds above 1 are reset to 1."""
        if run != self.run:
            if self.odds >= 1.0:
                self.confirmed, self.odds = self.run, 1.0
            self.run, self.run_misses = run, 0


class Presence:
    """The reducer. ``attendance`` is by Object, absorbed ones left out; ``missed`` are the Objects
    whose odds the last keyframe has lowered."""

    def __init__(self) -> None:
        self.attendance: dict[d.ObjectOrdinal, Attendance] = {}
        self.missed: list[d.ObjectOrdinal] = []
        # cell → Object → the first pose in it, or next to it, that the Object was seen from
        self._vantages: dict[_Cell, dict[d.ObjectOrdinal, tuple[float, float]]] = {}
        self._hits, self._misses = 0, 0

    def fold(
        self,
        offset: Offset,
        run: d.RunOrdinal,
        pose: d.Pose,
        camera: CameraConstants,
        fused: Iterable[d.Delta],
    ) -> list[d.ObjectMissing]:
        """Look for all Objects that this keyframe should see; ``fused`` are the deltas of fusion.

        One delta for each Object that is missing now or no longer is, ascending.
        """
        seen = self._apply(run, fused)
        changed = self._look(run, pose, camera, seen)
        for ordinal in seen:
            known = self.attendance[ordinal]
            known.seen = run
            if run != known.home:
                known.enter(run)
                known.odds = min(known.odds * _SEEN, _SURE)
                if known.is_missing and known.odds > _MISSING:
                    known.is_missing = False
                    changed.append(ordinal)
            self._add_vantage(ordinal, known, pose)
        return [
            d.ObjectMissing(offset, ordinal, run, known.run_misses, known.is_missing)
            for ordinal in sorted(changed)
            for known in (self.attendance[ordinal],)
        ]

    def relocate(self, old: d.ObjectOrdinal, new: d.ObjectOrdinal) -> None:
        """Forget the vantages of ``old``, which was relocated to where ``new``, now absorbed, was
        found."""
        self._unlist(old)
        self._unlist(new, old)
        known = self.attendance.pop(new)
        known.cells = self.attendance[old].cells
        self.attendance[old] = known

    def dump(self) -> State:
        """The whole state, to be kept."""
        known = sorted(self.attendance.items())
        vantages = sorted(
            (*c, o, *at) for c, near in self._vantages.items() for o, at in near.items()
        )
        return {
            "looks": [self._hits, self._misses],
            "objects": [
                [
                    *(o, k.home, k.run, k.confirmed, k.seen, k.looks_run),
                    *(k.hits, k.misses, k.run_misses, int(k.is_missing)),
                ]
                for o, k in known
            ],
            "looks_of_run": [
                [o, *cell, *counts] for o, k in known for cell, counts in sorted(k.looks.items())
            ],
            "numbers": np.array([(*k.estimate, k.odds) for _, k in known]).reshape(-1, 6),
            "cells": [list(row[:3]) for row in vantages],
            "poses": np.array([row[3:] for row in vantages]).reshape(-1, 2),
        }

    def load(self, state: State) -> None:
        """Restore the state of `dump`."""
        self._hits, self._misses = state["looks"]
        numbers = state["numbers"].tolist()
        for (ordinal, *known), (*estimate, odds) in zip(state["objects"], numbers, strict=True):
            home, run, confirmed, seen, looks_run, hits, misses, run_misses, is_missing = known
            self.attendance[ordinal] = Attendance(
                *(home, run, confirmed, seen, looks_run),
                (*estimate,),
                *(hits, misses, odds, run_misses, bool(is_missing)),
            )
        for ordinal, column, row, *counts in state["looks_of_run"]:
            self.attendance[ordinal].looks[column, row] = counts
        for (column, row, ordinal), at in zip(state["cells"], state["poses"].tolist(), strict=True):
            self._list(ordinal, (column, row), (at[0], at[1]))

    def _apply(self, run: d.RunOrdinal, fused: Iterable[d.Delta]) -> list[d.ObjectOrdinal]:
        """Apply estimates and merges; returns the Objects seen, ascending."""
        attendance, seen = self.attendance, set[d.ObjectOrdinal]()
        for delta in fused:
            if type(delta) is d.ObjectSeen:
                seen.add(delta.object)
            elif type(delta) is d.ObjectEstimated:
                attendance[delta.object].estimate = (
                    *(delta.x_um / 1e6, delta.y_um / 1e6),
                    *(delta.var_xx_um2 / 1e12, delta.var_xy_um2 / 1e12, delta.var_yy_um2 / 1e12),
                )
            elif type(delta) is d.ObjectFound:
                attendance[delta.object] = Attendance(run, run, run, run, run)
            elif type(delta) is d.ObjectsMerged:
                self._merge(delta.survivor, delta.absorbed)
                if delta.absorbed in seen:
                    seen.remove(delta.absorbed)
                    seen.add(delta.survivor)
        return sorted(seen)

    def _merge(self, survivor: d.ObjectOrdinal, absorbed: d.ObjectOrdinal) -> None:
        """Add up hits, misses and vantages. An Object was there in the runs that found either
        part."""
        known, other = self.attendance[survivor], self.attendance[absorbed]
        known.hits += other.hits
        known.misses += other.misses
        known.seen = max(known.seen, other.seen)
        if other.home != known.home:
            known.enter(max(known.run, other.run))
            known.odds = _SURE
        self._unlist(absorbed, survivor)
        del self.attendance[absorbed]

    def _look(
        self,
        run: d.RunOrdinal,
        pose: d.Pose,
        camera: CameraConstants,
        seen: Sequence[d.ObjectOrdinal],
    ) -> list[d.ObjectOrdinal]:
        """Count hits and misses; returns the Objects that became missing."""
        self.missed = []
        cell = pose.x_um // _CELL_UM, pose.y_um // _CELL_UM
        near = self._vantages.get(cell)
        if not near:
            return []
        missing: list[d.ObjectOrdinal] = []
        x, y = pose.x_um / 1e6, pose.y_um / 1e6
        cos, sin = cos_sin(pose.yaw_rad + camera.yaw_rad)
        half_cos, half_sin = half_field(camera.hfov_deg)
        inner = half_sin / half_cos * _INNER
        hits = misses = 0
        usual = _PRIOR * (self._misses + 2) / (self._hits + self._misses + 4)
        attendance = self.attendance
        for ordinal, vantage in near.items():
            known = attendance[ordinal]
            there_x, there_y, *_ = known.estimate
            dx, dy = there_x - x, there_y - y
            ahead, aside = dx * cos + dy * sin, dy * cos - dx * sin
            if not _is_inside(ahead, aside, inner):
                continue
            if not _is_similar(dx, dy, there_x - vantage[0], there_y - vantage[1]):
                continue
            is_hit = ordinal in seen
            weight = known.weight(run, cell, is_hit)
            if is_hit:
                known.hits += weight
                hits += weight
                continue
            if run != known.home:
                known.enter(run)
                if weight:
                    share = (usual + known.misses) / (_PRIOR + known.hits + known.misses)
                    share = share if weight == _WEIGHTS[0] else math.sqrt(share)
                    known.odds = max(known.odds * share, _FLOOR)
                known.run_misses += 1
                self.missed.append(ordinal)
            if known.is_missing:
                continue
            known.misses += weight
            misses += weight
            enough = known.run_misses >= _LEAST_MISSES and known.hits >= _LEAST_HITS
            if enough and known.odds < _MISSING:
                known.is_missing = True
                missing.append(ordinal)
        self._hits += hits
        self._misses += misses
        self.missed.sort()
        return missing

    def _add_vantage(self, ordinal: d.ObjectOrdinal, known: Attendance, pose: d.Pose) -> None:
        """Enter the pose in its cell and the three that are next to it."""
        left = (pose.x_um - _CELL_UM // 2) // _CELL_UM
        below = (pose.y_um - _CELL_UM // 2) // _CELL_UM
        for column in (left, left + 1):
            for row in (below, below + 1):
                if (column, row) not in known.cells:
                    self._list(ordinal, (column, row), (pose.x_um / 1e6, pose.y_um / 1e6))

    def _list(self, ordinal: d.ObjectOrdinal, cell: _Cell, at: tuple[float, float]) -> None:
        self.attendance[ordinal].cells.add(cell)
        self._vantages.setdefault(cell, {})[ordinal] = at

    def _unlist(self, ordinal: d.ObjectOrdinal, heir: d.ObjectOrdinal | None = None) -> None:
        """Remove an Object's vantages; ``heir`` gets those in cells where it has none."""
        known = self.attendance[ordinal]
        for cell in known.cells:
            at = self._vantages[cell].pop(ordinal)
            if heir is not None and cell not in self.attendance[heir].cells:
                self._list(heir, cell, at)
            elif not self._vantages[cell]:
                del self._vantages[cell]
        known.cells = set()


def would_see(pose: d.Pose, camera: CameraConstants, at: Metres) -> bool:
    """Whether a keyframe would look for a thing, if a sight from its pose is `similar_sights`."""
    cos, sin = cos_sin(pose.yaw_rad + camera.yaw_rad)
    half_cos, half_sin = half_field(camera.hfov_deg)
    dx, dy = at[0] - pose.x_um / 1e6, at[1] - pose.y_um / 1e6
    return _is_inside(dx * cos + dy * sin, dy * cos - dx * sin, half_sin / half_cos * _INNER)


def similar_sights(spots: NDArray[np.float64], at: Metres, vantage: Metres) -> NDArray[np.intp]:
    """The indices of the positions, in metres, shape (n, 2) and ascending by x, from which a
    keyframe looks for a thing that was seen from ``vantage``, where it faces the thing."""
    reach = math.sqrt(_NEAR_M2) + _ROUNDING_M
    first, last = np.searchsorted(spots[:, 0], (vantage[0] - reach, vantage[0] + reach))
    dx, dy = at[0] - spots[first:last, 0], at[1] - spots[first:last, 1]
    vx, vy = at[0] - vantage[0], at[1] - vantage[1]
    apart_x, apart_y = dx - vx, dy - vy
    far2, usual2, dot = dx * dx + dy * dy, vx * vx + vy * vy, dx * vx + dy * vy
    similar = apart_x * apart_x + apart_y * apart_y <= _NEAR_M2
    similar &= (far2 <= usual2 * _DISTANCES2) & (usual2 <= far2 * _DISTANCES2)
    similar &= (dot > 0.0) & (dot * dot >= _TURN2 * far2 * usual2)
    found: NDArray[np.intp] = np.flatnonzero(similar) + first
    return found


def _is_inside(ahead: float, aside: float, inner: float) -> bool:
    """Whether a thing, metres ahead and aside of a camera, lies well inside the picture."""
    return ahead >= _LEAST_AHEAD_M and abs(aside) <= ahead * inner


def _is_similar(dx: float, dy: float, vx: float, vy: float) -> bool:
    """Whether two lines of sight to one point, given as offsets, are of poses near each other and
    similar in direction and length."""
    apart_x, apart_y = dx - vx, dy - vy
    if apart_x * apart_x + apart_y * apart_y > _NEAR_M2:
        return False
    far2, usual2 = dx * dx + dy * dy, vx * vx + vy * vy
    if far2 > usual2 * _DISTANCES2 or usual2 > far2 * _DISTANCES2:
        return False
    dot = dx * vx + dy * vy
    return dot > 0.0 and dot * dot >= _TURN2 * far2 * usual2
