"""Names of places: a name belongs to the place that its anchor, a keyframe, is in.

Of several names in one place the newest command's counts; so a name survives merges. An anchor that
is in no place, or has not come yet, names nothing so far.
"""

from collections.abc import Iterable, Sequence

from eventsrc.envelope import Offset
from projections.corrections import Keyframe, PlaceName
from projections.deltas import (
    Delta,
    KeyframeOrdinal,
    KeyframePlaced,
    PlaceNamed,
    PlaceOrdinal,
    PlacesMerged,
)


class PlaceNames:
    """The reducer. Tell it the keyframe of each anchor, then what places changed.

    ``names`` are in the order of their commands; ``given`` is which of them each place has.
    """

    def __init__(self, names: Sequence[PlaceName]) -> None:
        self.names = names
        self.newest = {name.anchor: index for index, name in enumerate(names)}
        self.given: dict[PlaceOrdinal, int] = {}
        self._anchors: dict[KeyframeOrdinal, int] = {}

    def add_anchor(self, keyframe: KeyframeOrdinal, anchor: Keyframe) -> None:
        """A keyframe that may be an anchor."""
        index = self.newest.get(anchor)
        if index is not None:
            self._anchors[keyframe] = index

    def fold(self, offset: Offset, changes: Iterable[Delta]) -> list[PlaceNamed]:
        """Take over an event's changes of places; the names that follow, by place."""
        given, before = self.given, dict[PlaceOrdinal, int | None]()
        for delta in changes:
            if type(delta) is PlacesMerged:
                for place in delta.absorbed:
                    if place in given:
                        self._give(delta.survivor, given.pop(place), before)
            elif type(delta) is KeyframePlaced and delta.keyframe in self._anchors:
                self._give(delta.place, self._anchors[delta.keyframe], before)
        return [
            self.named(offset, place)
            for place in sorted(before)
            if place in given and given[place] != before[place]
        ]

    def changes_from(self, older: "PlaceNames", offset: Offset) -> list[PlaceNamed]:
        """What changes where these names replace ``older``, by place."""
        named = []
        for place in sorted(self.given.keys() | older.given.keys()):
            now = self.named(offset, place)
            if now != older.named(offset, place):
                named.append(now)
        return named

    def give(self, keyframe: KeyframeOrdinal, place: PlaceOrdinal) -> None:
        """An anchor is in a place."""
        self._give(place, self._anchors[keyframe], {})

    def _give(
        self, place: PlaceOrdinal, index: int, before: dict[PlaceOrdinal, int | None]
    ) -> None:
        now = self.given.get(place)
        before.setdefault(place, now)
        if now is None or index > now:
            self.given[place] = index

    def named(self, offset: Offset, place: PlaceOrdinal) -> PlaceNamed:
        """A place's name as a delta."""
        index = self.given.get(place)
        if index is None:
            return PlaceNamed(offset, place, None, None)
        name = self.names[index]
        return PlaceNamed(offset, place, name.name, name.offset)
