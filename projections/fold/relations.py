"""What follows from places and Objects: the names of places, which Object is located in which
place, and which places are next to each other.

*Names.* A name belongs to the place that its anchor, a keyframe, is in. Of several names in one
place the newest command's counts; so a name survives merges. An anchor that is in no place, or was
not folded yet, names nothing.

*Located-in.* An Object is in the place on whose floor it stands, where that is known (`standing`),
else in the place where most of its observations were made. One observation is one vote for the
place of its keyframe, as labelled now; noise does not vote, and votes once it is promoted. Ties go
to the place founded first. An Object none of whose observations has a place is
nowhere. The votes of an absorbed Object are its survivor's. An Object that was relocated to where
another was found, and absorbs that, has only the votes of the absorbed one.

*Adjacency.* ``shared_transitions(A, B)`` counts the pairs of consecutive placed keyframes of one
run, in keyframe_id order whatever order they arrived in and with noise skipped, whose places are A
and B, A ≠ B, in either direction and by their *current* labels. So it always equals a recount:

* a keyframe that gets a place is inserted between its two neighbours in the run: their transition
  is replaced by two new ones;
* when B is absorbed by A, A–B transitions are dropped (both ends are in A); B–C become A–C.
"""

from array import array
from bisect import bisect_right
from collections.abc import Iterable, Iterator, MutableSequence, Sequence

import numpy as np

from eventsrc.envelope.model import KeyframeId, Offset

from . import State, packed
from . import deltas as d
from .corrections import Keyframe, PlaceName
from .pair_groups import ObjectSurvivors, PlaceSurvivors
from .standing import Standing


class PlaceNames:
    """The reducer of place names. `add_anchor` precedes `fold` of the event of an anchor.

    ``names`` are in the order of their commands; ``given`` is which of them each place has.
    """

    def __init__(self, names: Sequence[PlaceName]) -> None:
        self.names = names
        self.newest = {name.anchor: index for index, name in enumerate(names)}
        self.given: dict[d.PlaceOrdinal, int] = {}
        self._anchors: dict[d.KeyframeOrdinal, int] = {}

    def followed_by(self, names: Sequence[PlaceName]) -> "PlaceNames":
        """These names and more, which come after them; `add_anchor` and `give` are still to be
        called for the new ones."""
        more = PlaceNames(())
        more.names, more.given, more._anchors = names, {**self.given}, {**self._anchors}
        new = enumerate(names[len(self.names) :], len(self.names))
        more.newest = self.newest | {name.anchor: index for index, name in new}
        return more

    def add_anchor(self, keyframe: d.KeyframeOrdinal, anchor: Keyframe) -> None:
        """Register a keyframe as an anchor, if it is one."""
        index = self.newest.get(anchor)
        if index is not None:
            self._anchors[keyframe] = index

    def fold(self, offset: Offset, changes: Iterable[d.Delta]) -> list[d.PlaceNamed]:
        """Apply an event's changes of places and return the resulting names, by place."""
        given, before = self.given, dict[d.PlaceOrdinal, int | None]()
        for delta in changes:
            if type(delta) is d.PlacesMerged:
                for place in delta.absorbed:
                    if place in given:
                        self._give(delta.survivor, given.pop(place), before)
            elif type(delta) is d.KeyframePlaced and delta.keyframe in self._anchors:
                self._give(delta.place, self._anchors[delta.keyframe], before)
        return [
            self.named(offset, place)
            for place in sorted(before)
            if place in given and given[place] != before[place]
        ]

    def changes_from(self, older: "PlaceNames", offset: Offset) -> list[d.PlaceNamed]:
        """The deltas, by place, of replacing the names of ``older`` by these."""
        named = []
        for place in sorted(self.given.keys() | older.given.keys()):
            now = self.named(offset, place)
            if now != older.named(offset, place):
                named.append(now)
        return named

    def give(self, keyframe: d.KeyframeOrdinal, place: d.PlaceOrdinal) -> None:
        """Give a place the name of an anchor in it."""
        self._give(place, self._anchors[keyframe], {})

    def _give(
        self, place: d.PlaceOrdinal, index: int, before: dict[d.PlaceOrdinal, int | None]
    ) -> None:
        now = self.given.get(place)
        before.setdefault(place, now)
        if now is None or index > now:
            self.given[place] = index

    def named(self, offset: Offset, place: d.PlaceOrdinal) -> d.PlaceNamed:
        """A place's name as a delta."""
        index = self.given.get(place)
        if index is None:
            return d.PlaceNamed(offset, place, None, None)
        name = self.names[index]
        return d.PlaceNamed(offset, place, name.name, name.offset)


class LocatedIn:
    """The reducer of located-in. Merges, placings and sightings are reported to it in order, before
    `collect_moves`; `decide_standing` where walls are known."""

    def __init__(self, standing: Standing) -> None:
        self._standing = standing
        self.votes: list[dict[d.PlaceOrdinal, int]] = []  # per Object: place → observations there
        self.located: list[d.PlaceOrdinal | None] = []  # per Object
        # place → Objects with votes there
        self.voters: dict[d.PlaceOrdinal, dict[d.ObjectOrdinal, None]] = {}
        # keyframe without a place → Objects it saw
        self.waiting: dict[d.KeyframeOrdinal, list[d.ObjectOrdinal]] = {}
        self.survivors = ObjectSurvivors()
        self._touched: dict[d.ObjectOrdinal, None] = {}

    def places_merged(self, survivor: d.PlaceOrdinal, absorbed: tuple[d.PlaceOrdinal, ...]) -> None:
        """Count the votes for absorbed places for the survivor."""
        for place in absorbed:
            self._touched.update(self._standing.place_absorbed(survivor, place))
            voters = self.voters.pop(place, {})
            for ordinal in voters:
                votes = self.votes[ordinal]
                votes[survivor] = votes.get(survivor, 0) + votes.pop(place)
            self._touched.update(voters)
            if voters:
                self.voters.setdefault(survivor, {}).update(voters)

    def objects_merged(self, survivor: d.ObjectOrdinal, absorbed: d.ObjectOrdinal) -> None:
        """Count the absorbed Object's votes, later ones too, for the survivor."""
        self.survivors.merge(survivor, (absorbed,))
        votes, others = self.votes[survivor], self.votes[absorbed]
        self.votes[absorbed], self.located[absorbed] = {}, None
        for place, count in others.items():
            votes[place] = votes.get(place, 0) + count
            del self.voters[place][absorbed]
            self.voters[place][survivor] = None
        self._touched.pop(absorbed, None)
        if others:
            self._touched[survivor] = None

    def keyframe_placed(self, keyframe: d.KeyframeOrdinal, place: d.PlaceOrdinal) -> None:
        """Count the votes of the Objects seen by a keyframe that had no place until now."""
        for ordinal in self.waiting.pop(keyframe, ()):
            self._vote(self.survivors.find(ordinal), place)

    def object_seen(
        self, ordinal: d.ObjectOrdinal, keyframe: d.KeyframeOrdinal, place: d.PlaceOrdinal | None
    ) -> None:
        """Count a vote of an Object observed from a keyframe that is in ``place``, or so far in
        none."""
        if ordinal == len(self.votes):
            self.votes.append({})
            self.located.append(None)
        if place is None:
            self.waiting.setdefault(keyframe, []).append(ordinal)
        else:
            self._vote(ordinal, place)

    def object_left(self, ordinal: d.ObjectOrdinal) -> None:
        """Drop the votes of an Object that was relocated, also pending ones of earlier
        keyframes."""
        for voted in self.votes[ordinal]:
            del self.voters[voted][ordinal]
        self.votes[ordinal] = {}
        self._touched[ordinal] = None
        for keyframe, waiting in list(self.waiting.items()):
            kept = [each for each in waiting if self.survivors.find(each) != ordinal]
            if kept:
                self.waiting[keyframe] = kept
            else:
                del self.waiting[keyframe]

    def decide_standing(self) -> None:
        """Decide where Objects stand whose estimate, or whose surroundings, changed."""
        self._touched.update(dict.fromkeys(self._standing.decide()))

    def collect_moves(self, offset: Offset) -> list[d.ObjectMoved]:
        """Recount the Objects whose votes changed; returns those that moved, ascending."""
        if not self._touched:
            return []
        moved = []
        for ordinal in sorted(self._touched):
            place = self._standing.place_of(ordinal)
            if place is None:
                place = _winner(self.votes[ordinal])
            if place != self.located[ordinal]:
                self.located[ordinal] = place
                moved.append(d.ObjectMoved(offset, ordinal, place))
        self._touched.clear()
        return moved

    def dump(self) -> State:
        """The whole state, to be kept."""
        return {
            "votes": [list(map(list, votes.items())) for votes in self.votes],
            "located": self.located,
            "waiting": [
                [keyframe, [*map(self.survivors.find, ordinals)]]
                for keyframe, ordinals in self.waiting.items()
            ],
        }

    def load(self, state: State) -> None:
        """Restore the state of `dump`."""
        self.votes = [dict(votes) for votes in state["votes"]]
        self.located = state["located"]
        self.waiting = dict(state["waiting"])
        for ordinal, votes in enumerate(self.votes):
            for place in votes:
                self.voters.setdefault(place, {})[d.ObjectOrdinal(ordinal)] = None

    def _vote(self, ordinal: d.ObjectOrdinal, place: d.PlaceOrdinal) -> None:
        votes = self.votes[ordinal]
        before = votes.get(place, 0)
        votes[place] = before + 1
        if before and self.located[ordinal] == place and ordinal not in self._touched:
            return  # one more vote for its own place cannot move it
        self.voters.setdefault(place, {})[ordinal] = None
        self._touched[ordinal] = None


def _winner(votes: dict[d.PlaceOrdinal, int]) -> d.PlaceOrdinal | None:
    if len(votes) == 1:
        return next(iter(votes))
    return min(votes, key=lambda place: (-votes[place], place), default=None)


_BLOCK = 2048


class SortedKeys:
    """A sorted map from int64 keys to places; adding a key returns the places of its neighbours. No
    key is ever added twice or removed.

    Blocks of at most 2,048 keys: adding in order appends to the last one, adding out of order moves
    at most one block's worth of memory.
    """

    __slots__ = ("_blocks", "_firsts")

    def __init__(self, keys: Iterable[int] = (), labels: Iterable[d.PlaceOrdinal] = ()) -> None:
        """From ascending keys and their labels."""
        self._firsts: list[int] = []
        self._blocks: list[tuple[array[int], MutableSequence[d.PlaceOrdinal]]] = []
        for key, label in zip(keys, labels, strict=True):
            self.add(key, label)

    def add(
        self, key: int, label: d.PlaceOrdinal
    ) -> tuple[d.PlaceOrdinal | None, d.PlaceOrdinal | None]:
        """Add a new key and return the labels of the keys just before and after it, None at the
        ends."""
        blocks = self._blocks
        if not blocks:
            self._firsts.append(key)
            blocks.append((array("q"), packed("i")))
        keys, labels = blocks[-1]
        if keys and key > keys[-1] and len(keys) < _BLOCK:  # nearly always
            before = labels[-1]
            keys.append(key)
            labels.append(label)
            return before, None
        block = max(bisect_right(self._firsts, key) - 1, 0)
        keys, labels = blocks[block]
        at = bisect_right(keys, key)
        earlier = labels[at - 1] if at else blocks[block - 1][1][-1] if block else None
        after: d.PlaceOrdinal | None = None
        if at < len(keys):
            after = labels[at]
        elif block + 1 < len(blocks):
            after = blocks[block + 1][1][0]
        keys.insert(at, key)
        labels.insert(at, label)
        self._firsts[block] = keys[0]
        if len(keys) > _BLOCK:
            cut = _BLOCK if key == keys[-1] else _BLOCK // 2
            blocks[block : block + 1] = (keys[:cut], labels[:cut]), (keys[cut:], labels[cut:])
            self._firsts.insert(block + 1, keys[cut])
        return earlier, after

    def items(self) -> Iterator[tuple[int, d.PlaceOrdinal]]:
        """All keys, ascending, and their labels."""
        for keys, labels in self._blocks:
            yield from zip(keys, labels, strict=True)


class Adjacency:
    """The reducer of adjacency. Merges and placings are reported to it in order, before
    `collect_changes`."""

    def __init__(self) -> None:
        self.placed: dict[d.RunOrdinal, SortedKeys] = {}  # keyframe_id → place it joined
        self.survivors = PlaceSurvivors()
        # place → place → transitions, both ways round
        self.edges: dict[d.PlaceOrdinal, dict[d.PlaceOrdinal, int]] = {}
        # changed edges, as they were
        self._before: dict[tuple[d.PlaceOrdinal, d.PlaceOrdinal], int] = {}

    def places_merged(self, survivor: d.PlaceOrdinal, absorbed: tuple[d.PlaceOrdinal, ...]) -> None:
        """Count the transitions of absorbed places for the survivor."""
        self.survivors.merge(survivor, absorbed)
        for place in absorbed:
            for other, count in sorted(self.edges.get(place, {}).items()):
                self._add(place, other, -count)
                if other != survivor:
                    self._add(survivor, other, count)
            self.edges.pop(place, None)

    def keyframe_placed(
        self, run: d.RunOrdinal, keyframe_id: KeyframeId, place: d.PlaceOrdinal
    ) -> None:
        """Count the transitions of a keyframe that had no place until now."""
        placed = self.placed.get(run)
        if placed is None:
            placed = self.placed[run] = SortedKeys()
        joined_before, joined_after = placed.add(keyframe_id, place)
        find = self.survivors.find
        before = place if joined_before is None else find(joined_before)
        after = place if joined_after is None else find(joined_after)
        if joined_before is not None and joined_after is not None and before != after:
            self._add(before, after, -1)
        if before != place:
            self._add(before, place, 1)
        if after != place:
            self._add(place, after, 1)

    def collect_changes(self, offset: Offset) -> list[d.PlacesLinked]:
        """The edges whose count changed since the last call, ascending."""
        if not self._before:
            return []
        linked = []
        for (a, b), before in sorted(self._before.items()):
            count = self.edges.get(a, {}).get(b, 0)
            if count != before:
                linked.append(d.PlacesLinked(offset, a, b, count))
        self._before.clear()
        return linked

    def dump(self) -> State:
        """The whole state, to be kept: the same for equal states, however they were reached."""
        columns = {run: [*placed.items()] for run, placed in sorted(self.placed.items())}
        edges = [[a, b, n] for a, row in self.edges.items() for b, n in row.items() if a < b]
        return {
            "placed": [[run, len(items)] for run, items in columns.items()],
            "keys": np.array([key for items in columns.values() for key, _ in items], np.int64),
            "labels": np.array(
                [place for items in columns.values() for _, place in items], np.int32
            ),
            "survivors": sorted(map(list, self.survivors.absorbed_by.items())),
            "edges": sorted(edges),
        }

    def load(self, state: State) -> None:
        """Restore the state of `dump`."""
        keys, labels = state["keys"].tolist(), state["labels"].tolist()
        start = 0
        for run, count in state["placed"]:
            end = start + count
            self.placed[run] = SortedKeys(keys[start:end], labels[start:end])
            start = end
        self.survivors.absorbed_by = dict(state["survivors"])
        for a, b, transitions in state["edges"]:
            self.edges.setdefault(a, {})[b] = transitions
            self.edges.setdefault(b, {})[a] = transitions

    def _add(self, a: d.PlaceOrdinal, b: d.PlaceOrdinal, change: int) -> None:
        count = self.edges.get(a, {}).get(b, 0)
        self._before.setdefault((a, b) if a < b else (b, a), count)
        for one, other in ((a, b), (b, a)):
            edges = self.edges.setdefault(one, {})
            if count + change:
                edges[other] = count + change
            else:
                edges.pop(other, None)
