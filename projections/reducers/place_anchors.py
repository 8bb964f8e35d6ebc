"""Anchors: the keyframes that ``join`` and ``keep-apart`` name, and which places they are in.

Anchors that are one by command are a group. Places with anchors of groups that are kept apart
*conflict*: they are never merged. A refusal is reported once for each pair of places.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import TypeAlias

from projections.corrections import Keyframe
from projections.deltas import KeyframeOrdinal, PlaceOrdinal
from projections.pair_groups import PairGroups
from projections.reducers import State

Inside: TypeAlias = dict[int, KeyframeOrdinal]
"""The groups of anchors in a place, with the earliest anchor of each."""
Apart: TypeAlias = tuple[KeyframeOrdinal, KeyframeOrdinal]
"""Two anchors that are kept apart, one on each of two sides."""


class PlaceAnchors:
    """The anchors that have come, and those in each place."""

    def __init__(self, groups: PairGroups[Keyframe]) -> None:
        self._groups = groups
        self._group_of: dict[KeyframeOrdinal, int] = {}
        self._inside: dict[PlaceOrdinal, Inside] = {}
        self._refused: set[tuple[PlaceOrdinal, PlaceOrdinal]] = set()

    def add(self, keyframe: KeyframeOrdinal, anchor: Keyframe) -> None:
        """A keyframe that may be an anchor."""
        group = self._groups.group_of.get(anchor)
        if group is not None:
            self._group_of[keyframe] = group

    @property
    def have_come(self) -> bool:
        """Whether any has."""
        return bool(self._group_of)

    def __contains__(self, keyframe: KeyframeOrdinal) -> bool:
        return keyframe in self._group_of

    def own(self, keyframe: KeyframeOrdinal) -> Inside:
        """What a place of this anchor alone has inside; nothing if it is none."""
        return {self._group_of[keyframe]: keyframe} if keyframe in self._group_of else {}

    def inside(self, place: PlaceOrdinal) -> Inside:
        """The anchors in a place."""
        return self._inside.get(place, {})

    def enter(self, place: PlaceOrdinal, inside: Inside) -> None:
        """Anchors are in a place from now on."""
        own = self._inside.setdefault(place, {})
        for group, keyframe in inside.items():
            own[group] = min(keyframe, own.get(group, keyframe))

    def merge(self, survivor: PlaceOrdinal, absorbed: Iterable[PlaceOrdinal]) -> None:
        """The anchors of ``absorbed`` are in ``survivor`` from now on."""
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
        """Note a refusal; whether it is the first of these places."""
        pair = min(a, b), max(a, b)
        is_news = pair not in self._refused
        self._refused.add(pair)
        return is_news

    def dump(self) -> State:
        """Everything, for a snapshot."""
        return {
            "anchors": [[keyframe, group] for keyframe, group in self._group_of.items()],
            "refused": sorted(map(list, self._refused)),
        }

    def load(
        self, state: State, place_of: Callable[[KeyframeOrdinal], PlaceOrdinal | None]
    ) -> None:
        """Take over what `dump` gave; ``place_of`` tells the place of a keyframe."""
        self._group_of = dict(state["anchors"])
        for keyframe in self._group_of:
            place = place_of(keyframe)
            if place is not None:
                self.enter(place, self.own(keyframe))
        self._refused = {(a, b) for a, b in state["refused"]}
