"""Presence beside a slow oracle that keeps every vantage and every look, and counts from scratch.

The oracle walks over all Objects and all poses each was seen from; it has no grid of Objects, no
running odds and no order but that of the ordinals. It counts looks in whole ones and odds in
fractions, squared, so that the root of a share is one, too.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from eventsrc.envelope.model import Offset
from projections.fold.deltas import (
    Delta,
    ObjectEstimated,
    ObjectFound,
    ObjectMissing,
    ObjectOrdinal,
    ObjectSeen,
    ObjectsMerged,
    ObservationOrdinal,
    Pose,
    RunOrdinal,
)
from projections.fold.exact import cos_sin
from projections.fold.presence import Presence
from projections.fold.settings import CameraConstants

CAMERA = CameraConstants(hfov_deg=70.0)


@dataclass
class Known:
    """All that happened to one Object. ``seen_from`` are poses in µm, the own before those of what
    it absorbed."""

    home: int
    run: int
    at: tuple[float, float] = (0.0, 0.0)
    seen_from: list[tuple[int, int]] = field(default_factory=list)
    hits: Fraction = Fraction(0)
    misses: Fraction = Fraction(0)
    odds2: Fraction = Fraction(1)
    run_misses: int = 0
    is_missing: bool = False
    seen: int = 0
    looks: list[tuple[int, int, int, bool]] = field(default_factory=list)

    def enter(self, run: int) -> None:
        if run != self.run:
            self.run, self.run_misses, self.odds2 = run, 0, min(self.odds2, Fraction(1))

    def weight(self, run: int, pose: Pose, is_hit: bool) -> Fraction:
        """The third look from a cell, with one outcome and no other run between, is no evidence."""
        look = run, pose.x_um // CELL, pose.y_um // CELL, is_hit
        self.looks = [known for known in self.looks if known[0] == run] + [look]
        return {1: Fraction(1), 2: Fraction(1, 2)}.get(self.looks.count(look), Fraction(0))


class Oracle:
    """`Presence` as its text says, with fractions, without an index."""

    def __init__(self) -> None:
        self.known: dict[int, Known] = {}
        self.hits, self.misses = Fraction(0), Fraction(0)

    def fold(self, offset: Offset, run: int, pose: Pose, fused: Sequence[Delta]) -> list[Delta]:
        seen: set[int] = set()
        for delta in fused:
            if isinstance(delta, ObjectFound):
                self.known[delta.object] = Known(run, run, seen=run)
            elif isinstance(delta, ObjectSeen):
                seen.add(delta.object)
            elif isinstance(delta, ObjectEstimated):
                self.known[delta.object].at = delta.x_um / 1e6, delta.y_um / 1e6
            elif isinstance(delta, ObjectsMerged):
                self.merge(delta.survivor, delta.absorbed)
                seen = {delta.survivor if o == delta.absorbed else o for o in seen}
        share = (self.misses + 1) / (self.hits + self.misses + 2)
        before = {o: k.is_missing for o, k in self.known.items()}
        for ordinal in sorted(self.known):
            if self.looks_for(ordinal, pose):
                known = self.known[ordinal]
                weight = known.weight(run, pose, ordinal in seen)
                self.look(known, run, share, weight, ordinal in seen)
        for ordinal in seen:
            known = self.known[ordinal]
            known.seen_from.append((pose.x_um, pose.y_um))
            known.seen = run
            if run != known.home:
                known.enter(run)
                known.odds2 = min(known.odds2 * 64, Fraction(512) ** 2)
                known.is_missing = known.is_missing and known.odds2 <= Fraction(1, 100)
        return [
            ObjectMissing(offset, ObjectOrdinal(o), RunOrdinal(run), k.run_misses, k.is_missing)
            for o, k in sorted(self.known.items())
            if k.is_missing != before[o]
        ]

    def merge(self, survivor: int, absorbed: int) -> None:
        known, other = self.known[survivor], self.known.pop(absorbed)
        known.hits += other.hits
        known.misses += other.misses
        known.seen_from += other.seen_from
        known.seen = max(known.seen, other.seen)
        if other.home != known.home:
            known.enter(max(known.run, other.run))
            known.odds2 = Fraction(512) ** 2

    def relocate(self, old: int, new: int) -> None:
        self.known[old] = self.known.pop(new)

    def looks_for(self, ordinal: int, pose: Pose) -> bool:
        """Whether the Object should be seen: the first pose in a cell next to this one counts."""
        known = self.known[ordinal]
        near = [at for at in known.seen_from if is_next_to(at, pose)]
        if not near:
            return False
        x, y = pose.x_um / 1e6, pose.y_um / 1e6
        cos, sin = cos_sin(pose.yaw_rad)
        dx, dy = known.at[0] - x, known.at[1] - y
        ahead, aside = dx * cos + dy * sin, dy * cos - dx * sin
        if ahead < 0.3 or math.atan2(abs(aside), ahead) > math.atan(INNER):
            return False
        vx, vy = known.at[0] - near[0][0] / 1e6, known.at[1] - near[0][1] / 1e6
        far, usual = math.hypot(dx, dy), math.hypot(vx, vy)
        if math.dist((dx, dy), (vx, vy)) > 1.1 or far > 1.6 * usual or usual > 1.6 * far:
            return False
        return dx * vx + dy * vy >= 0.87 * far * usual

    def look(
        self, known: Known, run: int, share: Fraction, weight: Fraction, is_seen: bool
    ) -> None:
        if is_seen:
            known.hits += weight
            self.hits += weight
            return
        if run != known.home:
            known.enter(run)
            missed = (4 * share + known.misses) / (4 + known.hits + known.misses)
            for _ in range(int(2 * weight)):
                known.odds2 *= missed
            known.odds2 = max(known.odds2, Fraction(1, 1024) ** 2)
            known.run_misses += 1
        if not known.is_missing:
            known.misses += weight
            self.misses += weight
            enough = known.run_misses >= 2 and known.hits >= 1
            known.is_missing = enough and known.odds2 < Fraction(1, 100)


class Step(NamedTuple):
    """A keyframe, and after it an Object found elsewhere: that it is, and where."""

    run: int
    pose: Pose
    deltas: list[Delta]
    moved: tuple[int, int] | None


INNER = math.tan(math.radians(35)) * 0.84
CELL = 750_000


def is_next_to(at: tuple[int, int], pose: Pose) -> bool:
    """Whether the cell of a pose is one of the four nearest to another pose."""
    return all(
        abs((2 * (here // CELL) + 1) * CELL - 2 * there) <= 2 * CELL
        and here // CELL in ((there - CELL // 2) // CELL, (there - CELL // 2) // CELL + 1)
        for there, here in zip(at, (pose.x_um, pose.y_um), strict=True)
    )


@st.composite
def stories(draw: st.DrawFn) -> list[Step]:
    """Keyframes of three runs, in each of which some Objects are gone: what was found, seen, merged
    and relocated. Few poses, so that they come again; some see nothing of what is ahead."""
    alive: list[int] = []
    story: list[Step] = []
    number = 0
    for run in range(3):
        gone = draw(st.sets(st.integers(0, 4)))
        for _ in range(draw(st.integers(3, 10))):
            x, y = draw(st.integers(0, 4)) * 231_001, draw(st.integers(0, 1)) * 301_001
            pose = Pose(x, y, draw(st.sampled_from([0.0, 0.0, 0.3, -0.4, 1.6, 9.5])))
            deltas: list[Delta] = []
            seen = [
                o for o in alive if (o not in gone and draw(st.integers(0, 2))) or not draw(RARE)
            ]
            if number < 5 and draw(st.booleans()):
                deltas.append(ObjectFound(1, ObjectOrdinal(number), "o", "c", OBSERVATION))
                seen.append(number)
                alive.append(number)
                number += 1
            deltas += [ObjectSeen(1, ObjectOrdinal(o), OBSERVATION, 0, 1, 0, 0, 0, 0) for o in seen]
            if len(seen) > 1 and not draw(RARE):
                pair = ObjectOrdinal(min(seen)), ObjectOrdinal(max(seen))
                deltas.append(ObjectsMerged(1, *pair, 1, 0, 0, 0, 0))
                seen.remove(pair[1])
                alive.remove(pair[1])
            for o in seen:
                there = 2_000_003 + 100_003 * (o % 5), 300_007 * (o % 3)
                deltas.append(ObjectEstimated(1, ObjectOrdinal(o), *there, 1, 0, 1, 1))
            moved = None
            if len(alive) > 1 and not draw(RARE):
                moved = alive[0], alive.pop()
            story.append(Step(run, pose, deltas, moved))
    return story


RARE = st.integers(0, 12)
OBSERVATION = ObservationOrdinal(0)


@given(stories(), st.integers(0, 30))
def test_presence_tells_what_the_oracle_tells_also_when_kept_and_loaded(story, cut):
    presence, oracle = Presence(), Oracle()
    for number, (run, pose, deltas, moved) in enumerate(story):
        if number == cut:
            state = presence.dump()
            presence = Presence()
            presence.load(state)
            assert_equal(presence.dump(), state)
        offset = Offset(number)
        told = presence.fold(offset, RunOrdinal(run), pose, CAMERA, deltas)
        assert told == oracle.fold(offset, run, pose, deltas)
        for delta in told:
            event("missing" if delta.missing else "back")
        if moved is not None:
            presence.relocate(ObjectOrdinal(moved[0]), ObjectOrdinal(moved[1]))
            oracle.relocate(*moved)
    assert presence.attendance.keys() == oracle.known.keys()
    for ordinal, known in oracle.known.items():
        attendance = presence.attendance[ObjectOrdinal(ordinal)]
        assert (attendance.hits, attendance.misses) == (2 * known.hits, 2 * known.misses)
        assert (attendance.seen, attendance.estimate[:2]) == (known.seen, known.at)
        assert attendance.odds == pytest.approx(math.sqrt(known.odds2))


def assert_equal(one: dict[str, Any], other: dict[str, Any]) -> None:
    assert one.keys() == other.keys()
    for key, value in one.items():
        assert np.array_equal(value, other[key]), key
