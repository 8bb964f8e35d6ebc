"""Anchors: the keyframes named by ``join`` and ``keep-apart``, and their places.

Anchors joined by command are a group. Places with anchors of groups that are kept apart *conflict*:
they are never merged. A refusal is reported once for each pair of places.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import TypeAlias

from . import State
from .corrections import Keyframe
from .deltas import KeyframeOrdinal, PlaceOrdinal
from .pair_groups import PairGroups

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
        pairs = self._groups.conflicts(inside, other)
        return min(((inside[a], other[b]) for a, b in pairs), default=None)

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
        """The whole state, for a snapshot."""
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
