"""State that all rules of places share: the place that each keyframe joined, each place's members,
and the anchors: the keyframes named by ``join`` and ``keep-apart``.

Points are numbered by arrival among the keyframes that have a pose. Places only grow or merge. A
place is named by the run of its founder and a counter of that run, and numbered in founding order;
of places that merge the one founded first survives, whatever the text of its id.

Anchors joined by command are a group. Places with anchors of groups that are kept apart *conflict*:
they are never merged. A refusal is reported once for each pair of places.
"""

from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, MutableSequence
from typing import NamedTuple, TypeAlias

import numpy as np

from eventsrc.envelope.model import Offset, RunId

from . import State, packed
from .corrections import Keyframe
from .deltas import KeyframeOrdinal, PlaceChanged, PlaceFormed, PlaceOrdinal, RunOrdinal
from .pair_groups import PairGroups, PlaceSurvivors

NOISE = PlaceOrdinal(-1)
"""The value for a point in no place, in the packed array of places."""


class PosedKeyframe(NamedTuple):
    """A keyframe with a pose, the input of the reducers of places; ``offset`` is its event."""

    offset: Offset
    keyframe: KeyframeOrdinal
    run: RunOrdinal
    run_id: RunId
    x_um: int
    y_um: int


class PlaceMembers:
    """The state that rules of places share, and the operations on it."""

    def __init__(self) -> None:
        # Per point: the place it joined, as of then; its keyframe; its run.
        self.joined: MutableSequence[PlaceOrdinal] = packed("i")
        self.keyframes: MutableSequence[KeyframeOrdinal] = packed("i")
        self.runs: MutableSequence[RunOrdinal] = packed("i")
        # Per run: its id, and how many places it has founded.
        self.run_ids: dict[RunOrdinal, RunId] = {}
        self.founded: dict[RunOrdinal, int] = {}
        self.survivors = PlaceSurvivors()
        # Per place, of its current members:
        self.member_counts: list[int] = []
        self.sums_x_um: list[int] = []
        self.sums_y_um: list[int] = []

    def add_point(self, keyframe: KeyframeOrdinal, run: RunOrdinal, run_id: RunId) -> int:
        """Add a keyframe with a pose, in no place yet, and return its point."""
        self.joined.append(NOISE)
        self.keyframes.append(keyframe)
        self.runs.append(run)
        self.run_ids[run] = run_id
        return len(self.joined) - 1

    def label(self, point: int) -> PlaceOrdinal | None:
        """The point's current place; None for noise."""
        joined = self.joined[point]
        return None if joined == NOISE else self.survivors.find(joined)

    def place_of(self, keyframe: KeyframeOrdinal) -> PlaceOrdinal | None:
        """A keyframe's current place; None for noise, or without a pose."""
        point = self.point_of(keyframe)
        is_there = point < len(self.keyframes) and self.keyframes[point] == keyframe
        return self.label(point) if is_there else None

    def point_of(self, keyframe: KeyframeOrdinal) -> int:
        """A keyframe's point; for one without a pose the point of the next."""
        return bisect_left(self.keyframes, keyframe)

    def form_place(self, offset: Offset, founder: int) -> PlaceFormed:
        """Add a place without members, founded by a point."""
        place, run = PlaceOrdinal(len(self.member_counts)), self.runs[founder]
        counter = self.founded.get(run, 0)
        self.founded[run] = counter + 1
        self.member_counts.append(0)
        self.sums_x_um.append(0)
        self.sums_y_um.append(0)
        place_id = f"{self.run_ids[run]}_p{counter}"
        return PlaceFormed(offset, place, place_id, self.keyframes[founder])

    def join_place(self, point: int, place: PlaceOrdinal, x_um: int, y_um: int) -> None:
        """Add a point at (x, y) to a place."""
        self.joined[point] = place
        self.member_counts[place] += 1
        self.sums_x_um[place] += x_um
        self.sums_y_um[place] += y_um

    def absorb(self, survivor: PlaceOrdinal, absorbed: tuple[PlaceOrdinal, ...]) -> None:
        """Move the members of ``absorbed`` to ``survivor``."""
        self.survivors.merge(survivor, absorbed)
        for place in absorbed:
            self.member_counts[survivor] += self.member_counts[place]
            self.sums_x_um[survivor] += self.sums_x_um[place]
            self.sums_y_um[survivor] += self.sums_y_um[place]

    def place_changed(self, offset: Offset, place: PlaceOrdinal) -> PlaceChanged:
        """The delta with the current size and sums of a place."""
        return PlaceChanged(
            offset,
            place,
            self.member_counts[place],
            self.sums_x_um[place],
            self.sums_y_um[place],
        )

    def dump(self) -> State:
        """The whole state, to be kept."""
        absorbed_by, places = self.survivors.absorbed_by, range(len(self.member_counts))
        return {
            "joined": np.array(self.joined, np.int32),
            "keyframes": np.array(self.keyframes, np.int32),
            "runs": np.array(self.runs, np.int32),
            "run_ids": [[run, run_id] for run, run_id in self.run_ids.items()],
            "founded": [[run, count] for run, count in self.founded.items()],
            "survivors": [absorbed_by.get(PlaceOrdinal(p), p) for p in places],
            "member_counts": self.member_counts,
            "sums_x_um": self.sums_x_um,
            "sums_y_um": self.sums_y_um,
        }

    def load(self, state: State) -> None:
        """Restore the state of `dump`."""
        self.joined = packed("i", state["joined"].tobytes())
        self.keyframes = packed("i", state["keyframes"].tobytes())
        self.runs = packed("i", state["runs"].tobytes())
        self.run_ids = dict(state["run_ids"])
        self.founded = dict(state["founded"])
        parents = enumerate(state["survivors"])
        self.survivors.absorbed_by = {PlaceOrdinal(p): s for p, s in parents if p != s}
        self.member_counts = state["member_counts"]
        self.sums_x_um = state["sums_x_um"]
        self.sums_y_um = state["sums_y_um"]


Inside: TypeAlias = dict[int, KeyframeOrdinal]
"""The groups of anchors in a place, with the earliest anchor of each."""
Apart: TypeAlias = tuple[KeyframeOrdinal, KeyframeOrdinal]
"""Two anchors that are kept apart, one on each of two sides."""


class PlaceAnchors:
    """The anchors folded so far, and those in each place."""

    def __init__(self, groups: PairGroups[Keyframe]) -> None:
        self._groups = groups
        self._group_of: dict[KeyframeOrdinal, int] = {}
        self._inside: dict[PlaceOrdinal, Inside] = {}
        self._refused: set[tuple[PlaceOrdinal, PlaceOrdinal]] = set()

    def add(self, keyframe: KeyframeOrdinal, anchor: Keyframe) -> None:
        """Register a keyframe as an anchor, if it is one."""
        group = self._groups.group_of.get(anchor)
        if group is not None:
            self._group_of[keyframe] = group

    @property
    def have_come(self) -> bool:
        """Whether any anchor has been folded."""
        return bool(self._group_of)

    def __contains__(self, keyframe: KeyframeOrdinal) -> bool:
        return keyframe in self._group_of

    def own(self, keyframe: KeyframeOrdinal) -> Inside:
        """The anchors in a place that holds only this keyframe; empty if it is no anchor."""
        return {self._group_of[keyframe]: keyframe} if keyframe in self._group_of else {}

    def inside(self, place: PlaceOrdinal) -> Inside:
        """The anchors in a place."""
        return self._inside.get(place, {})

    def enter(self, place: PlaceOrdinal, inside: Inside) -> None:
        """Add anchors to a place."""
        own = self._inside.setdefault(place, {})
        for group, keyframe in inside.items():
            own[group] = min(keyframe, own.get(group, keyframe))

    def merge(self, survivor: PlaceOrdinal, absorbed: Iterable[PlaceOrdinal]) -> None:
        """Move the anchors of ``absorbed`` to ``survivor``."""
        for place in absorbed:
            if place in self._inside:
                self.enter(survivor, self._inside.pop(place))

    def apart(self, inside: Inside, other: Inside) -> Apart | None:
        """The earliest anchors of two sides that are kept apart, None if there are none."""
        if not inside or not other:
            return None
        conflicts = self._groups.conflicts
        if len(inside) > len(other):
            pairs = [
                (min(map(inside.__getitem__, against)), other[group])
                for group, against in conflicts(other, inside.keys())
            ]
            return min(pairs, default=None)
        earliest = sorted(inside, key=inside.__getitem__) if len(inside) > 1 else inside
        for group, against in conflicts(earliest, other.keys()):
            return inside[group], min(map(other.__getitem__, against))
        return None

    def are_apart(self, inside: Inside, other: Inside) -> bool:
        """Whether any anchors of two sides are kept apart."""
        return self._groups.are_apart(inside.keys(), other.keys())

    def to_join(self, keyframe: KeyframeOrdinal) -> Iterator[tuple[PlaceOrdinal, KeyframeOrdinal]]:
        """The places with an anchor of this one's group, in founding order, and that anchor."""
        group = self._group_of[keyframe]
        for place in sorted(p for p, inside in self._inside.items() if group in inside):
            yield place, self._inside[place][group]

    def refuses(self, a: PlaceOrdinal, b: PlaceOrdinal) -> bool:
        """Record a refusal; returns whether it is the first for these two places."""
        pair = min(a, b), max(a, b)
        is_news = pair not in self._refused
        self._refused.add(pair)
        return is_news

    def dump(self) -> State:
        """The whole state, to be kept."""
        return {
            "anchors": [[keyframe, group] for keyframe, group in self._group_of.items()],
            "refused": sorted(map(list, self._refused)),
        }

    def load(
        self, state: State, place_of: Callable[[KeyframeOrdinal], PlaceOrdinal | None]
    ) -> None:
        """Restore the state of `dump`; ``place_of`` returns the place of a keyframe."""
        self._group_of = dict(state["anchors"])
        for keyframe in self._group_of:
            place = place_of(keyframe)
            if place is not None:
                self.enter(place, self.own(keyframe))
        self._refused = {(a, b) for a, b in state["refused"]}
