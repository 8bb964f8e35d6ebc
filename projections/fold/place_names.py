"""Names of places: a name belongs to the place that its anchor, a keyframe, is in.

Of several names in one place the newest command's counts; so a name survives merges. An anchor that
is in no place, or was not folded yet, names nothing.
"""

from collections.abc import Iterable, Sequence

from eventsrc.envelope.model import Offset

from .corrections import Keyframe, PlaceName
from .deltas import Delta, KeyframeOrdinal, KeyframePlaced, PlaceNamed, PlaceOrdinal, PlacesMerged


class PlaceNames:
    """The reducer of place names. `add_anchor` precedes `fold` of the event of an anchor.

    ``names`` are in the order of their commands; ``given`` is which of them each place has.
    """

    def __init__(self, names: Sequence[PlaceName]) -> None:
        self.names = names
        self.newest = {name.anchor: index for index, name in enumerate(names)}
        self.given: dict[PlaceOrdinal, int] = {}
        self._anchors: dict[KeyframeOrdinal, int] = {}

    def followed_by(self, names: Sequence[PlaceName]) -> "PlaceNames":
        """These names and more, which come after them; `add_anchor` and `give` are still to be
        called for the new ones."""
        more = PlaceNames(())
        more.names, more.given, more._anchors = names, {**self.given}, {**self._anchors}
        new = enumerate(names[len(self.names) :], len(self.names))
        more.newest = self.newest | {name.anchor: index for index, name in new}
        return more

    def add_anchor(self, keyframe: KeyframeOrdinal, anchor: Keyframe) -> None:
        """Register a keyframe as an anchor, if it is one."""
        index = self.newest.get(anchor)
        if index is not None:
            self._anchors[keyframe] = index

    def fold(self, offset: Offset, changes: Iterable[Delta]) -> list[PlaceNamed]:
        """Apply an event's changes of places and return the resulting names, by place."""
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
        """The deltas, by place, of replacing the names of ``older`` by these."""
        named = []
        for place in sorted(self.given.keys() | older.given.keys()):
            now = self.named(offset, place)
            if now != older.named(offset, place):
                named.append(now)
        return named

    def give(self, keyframe: KeyframeOrdinal, place: PlaceOrdinal) -> None:
        """Give a place the name of an anchor in it."""
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
