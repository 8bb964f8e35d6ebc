"""Adjacency: how often a robot passed from one place straight into another.

``shared_transitions(A, B)`` counts the pairs of consecutive placed keyframes of one run, in
keyframe_id order whatever order they arrived in and with noise skipped, whose places are A and B,
A ≠ B, in either direction and by their *current* labels. So it always equals a recount:

* a keyframe that gets a place is inserted between its two neighbours in the run: their transition
  is replaced by two new ones;
* when B is absorbed by A, A–B transitions are dropped (both ends are in A); B–C become A–C.
"""

from array import array
from bisect import bisect_right
from collections.abc import MutableSequence

import numpy as np

from eventsrc.envelope.model import KeyframeId, Offset

from . import State, packed
from .deltas import PlaceOrdinal, PlacesLinked, RunOrdinal
from .survivors import PlaceSurvivors

_BLOCK = 2048


class SortedKeys:
    """A sorted map from int64 keys to places; adding a key returns the places of its neighbours.

    Blocks of at most 2,048 keys: adding in order appends to the last one, adding out of order moves
    at most one block's worth of memory. No key is ever added twice or removed.
    """

    __slots__ = ("_firsts", "_keys", "_labels")

    def __init__(self) -> None:
        self._keys: list[array[int]] = []
        self._labels: list[MutableSequence[PlaceOrdinal]] = []
        self._firsts: list[int] = []

    def add(self, key: int, label: PlaceOrdinal) -> tuple[PlaceOrdinal | None, PlaceOrdinal | None]:
        """Add a new key and return the labels of the keys just before and after it, None at the
        ends."""
        if not self._keys:
            self._open_block(key, label)
            return None, None
        if key > self._keys[-1][-1]:
            return self._append(key, label), None
        block = max(bisect_right(self._firsts, key) - 1, 0)
        keys, labels = self._keys[block], self._labels[block]
        index = bisect_right(keys, key)
        around = self._before(block, index), self._after(block, index)
        keys.insert(index, key)
        labels.insert(index, label)
        self._firsts[block] = keys[0]
        if len(keys) > _BLOCK:
            self._split(block)
        return around

    def _append(self, key: int, label: PlaceOrdinal) -> PlaceOrdinal:
        """Add a key above all others and return the label of the one before."""
        keys, labels = self._keys[-1], self._labels[-1]
        before = labels[-1]
        if len(keys) == _BLOCK:
            self._open_block(key, label)
        else:
            keys.append(key)
            labels.append(label)
        return before

    def _open_block(self, key: int, label: PlaceOrdinal) -> None:
        """Begin a new last block with a key above all others."""
        labels: MutableSequence[PlaceOrdinal] = packed("i")
        labels.append(label)
        self._keys.append(array("q", [key]))
        self._labels.append(labels)
        self._firsts.append(key)

    def columns(self) -> tuple["array[int]", MutableSequence[PlaceOrdinal]]:
        """All keys, ascending, and their labels."""
        keys, labels = array("q"), packed("i")
        for block, others in zip(self._keys, self._labels, strict=True):
            keys += block
            labels += others
        return keys, labels

    @classmethod
    def of(cls, keys: "array[int]", labels: MutableSequence[PlaceOrdinal]) -> "SortedKeys":
        """From ascending keys and their labels."""
        made = cls()
        for start in range(0, len(keys), _BLOCK):
            made._keys.append(keys[start : start + _BLOCK])
            made._labels.append(labels[start : start + _BLOCK])
            made._firsts.append(keys[start])
        return made

    def _before(self, block: int, index: int) -> PlaceOrdinal | None:
        if index > 0:
            return self._labels[block][index - 1]
        return self._labels[block - 1][-1] if block > 0 else None

    def _after(self, block: int, index: int) -> PlaceOrdinal | None:
        if index < len(self._labels[block]):
            return self._labels[block][index]
        return self._labels[block + 1][0] if block + 1 < len(self._labels) else None

    def _split(self, block: int) -> None:
        at = _BLOCK // 2
        keys, labels = self._keys[block], self._labels[block]
        self._keys.insert(block + 1, keys[at:])
        self._labels.insert(block + 1, labels[at:])
        del keys[at:], labels[at:]
        self._firsts.insert(block + 1, self._keys[block + 1][0])


class Adjacency:
    """The reducer of adjacency. Merges and placings are reported to it in order, before
    `collect_changes`."""

    def __init__(self) -> None:
        self.placed: dict[RunOrdinal, SortedKeys] = {}  # keyframe_id → place it joined
        self.survivors = PlaceSurvivors()
        # place → place → transitions, both ways round
        self.edges: dict[PlaceOrdinal, dict[PlaceOrdinal, int]] = {}
        # changed edges, as they were
        self._before: dict[tuple[PlaceOrdinal, PlaceOrdinal], int] = {}

    def places_merged(self, survivor: PlaceOrdinal, absorbed: tuple[PlaceOrdinal, ...]) -> None:
        """Count the transitions of absorbed places for the survivor."""
        self.survivors.merge(survivor, absorbed)
        for place in absorbed:
            for other, count in sorted(self.edges.get(place, {}).items()):
                self._add(place, other, -count)
                if other != survivor:
                    self._add(survivor, other, count)
            self.edges.pop(place, None)

    def keyframe_placed(
        self, run: RunOrdinal, keyframe_id: KeyframeId, place: PlaceOrdinal
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

    def collect_changes(self, offset: Offset) -> list[PlacesLinked]:
        """The edges whose count changed since the last call, ascending."""
        if not self._before:
            return []
        linked = []
        for (a, b), before in sorted(self._before.items()):
            count = self.edges.get(a, {}).get(b, 0)
            if count != before:
                linked.append(PlacesLinked(offset, a, b, count))
        self._before.clear()
        return linked

    def dump(self) -> State:
        """The whole state, for a snapshot: the same for equal states, however they were reached."""
        columns = {run: placed.columns() for run, placed in sorted(self.placed.items())}
        edges = [[a, b, n] for a, row in self.edges.items() for b, n in row.items() if a < b]
        return {
            "placed": [[run, len(keys)] for run, (keys, _) in columns.items()],
            "keys": np.array([k for keys, _ in columns.values() for k in keys], np.int64),
            "labels": np.array([p for _, labels in columns.values() for p in labels], np.int32),
            "survivors": sorted(map(list, self.survivors.absorbed_by.items())),
            "edges": sorted(edges),
        }

    def load(self, state: State) -> None:
        """Restore the state of `dump`."""
        start = 0
        for run, count in state["placed"]:
            keys = array("q", state["keys"][start : start + count].tobytes())
            labels = packed("i", state["labels"][start : start + count].tobytes())
            self.placed[run] = SortedKeys.of(keys, labels)
            start += count
        self.survivors.absorbed_by = dict(state["survivors"])
        for a, b, transitions in state["edges"]:
            self.edges.setdefault(a, {})[b] = transitions
            self.edges.setdefault(b, {})[a] = transitions

    def _add(self, a: PlaceOrdinal, b: PlaceOrdinal, change: int) -> None:
        count = self.edges.get(a, {}).get(b, 0)
        self._before.setdefault((a, b) if a < b else (b, a), count)
        for one, other in ((a, b), (b, a)):
            edges = self.edges.setdefault(one, {})
            if count + change:
                edges[other] = count + change
            else:
                edges.pop(other, None)
