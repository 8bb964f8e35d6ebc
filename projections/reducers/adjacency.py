"""Adjacency: how often a robot passed from one place straight into another.

``shared_transitions(A, B)`` counts the pairs of consecutive placed keyframes of one run, in
keyframe_id order whatever order they arrived in and with noise skipped, whose places are A and B,
A ≠ B, in either direction and by their *current* labels. So it always equals a recount:

* a keyframe that gets a place comes between its two neighbours in the run: their own transition
  goes, two new ones come;
* when B is absorbed by A, A–B transitions are inside a place now and vanish; B–C become A–C.

Sorted integers with a label each, cheap to add to in any order.

Blocks of at most 2,048 keys: adding in order appends to the last one, adding out of order moves at
most one block's worth of memory. No key is ever added twice or removed.
"""

from array import array
from bisect import bisect_right

import numpy as np

from eventsrc.envelope import Offset
from projections.deltas import PlacesLinked
from projections.reducers import State

_BLOCK = 2048


class SortedKeys:
    """A sorted map from int64 keys to int32 labels that can be asked for the keys around one."""

    __slots__ = ("_firsts", "_keys", "_labels")

    def __init__(self) -> None:
        self._keys: list[array[int]] = []
        self._labels: list[array[int]] = []
        self._firsts: list[int] = []

    def add(self, key: int, label: int) -> tuple[int | None, int | None]:
        """Add a new key; the labels of the keys just before and after it, None at the ends."""
        if not self._keys:
            self._keys, self._labels = [array("q", [key])], [array("i", [label])]
            self._firsts = [key]
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

    def _append(self, key: int, label: int) -> int:
        """Add a key above all others; the label of the one before."""
        keys, labels = self._keys[-1], self._labels[-1]
        before = labels[-1]
        if len(keys) == _BLOCK:
            self._keys.append(array("q", [key]))
            self._labels.append(array("i", [label]))
            self._firsts.append(key)
        else:
            keys.append(key)
            labels.append(label)
        return before

    def columns(self) -> tuple["array[int]", "array[int]"]:
        """All keys, ascending, and their labels."""
        keys, labels = array("q"), array("i")
        for block, others in zip(self._keys, self._labels, strict=True):
            keys += block
            labels += others
        return keys, labels

    @classmethod
    def of(cls, keys: "array[int]", labels: "array[int]") -> "SortedKeys":
        """From ascending keys and their labels."""
        made = cls()
        for start in range(0, len(keys), _BLOCK):
            made._keys.append(keys[start : start + _BLOCK])
            made._labels.append(labels[start : start + _BLOCK])
            made._firsts.append(keys[start])
        return made

    def _before(self, block: int, index: int) -> int | None:
        if index > 0:
            return self._labels[block][index - 1]
        return self._labels[block - 1][-1] if block > 0 else None

    def _after(self, block: int, index: int) -> int | None:
        if index < len(self._labels[block]):
            return self._labels[block][index]
        return self._labels[block + 1][0] if block + 1 < len(self._labels) else None

    def _split(self, block: int) -> None:
        at = _BLOCK // 2
        for columns in (self._keys, self._labels):
            columns.insert(block + 1, columns[block][at:])
            del columns[block][at:]
        self._firsts.insert(block + 1, self._keys[block + 1][0])


class Adjacency:
    """The reducer. Tell it what happened, in order; then ask which edges changed."""

    def __init__(self) -> None:
        self.placed: dict[int, SortedKeys] = {}  # per run: keyframe_id → place it joined
        self.survivors: dict[int, int] = {}  # absorbed place → who absorbed it
        self.edges: dict[int, dict[int, int]] = {}  # place → place → transitions, both ways round
        self._before: dict[tuple[int, int], int] = {}  # changed edges, as they were

    def places_merged(self, survivor: int, absorbed: tuple[int, ...]) -> None:
        """The absorbed places' transitions are the survivor's now."""
        for place in absorbed:
            self.survivors[place] = survivor
            for other, count in sorted(self.edges.get(place, {}).items()):
                self._add(place, other, -count)
                if other != survivor:
                    self._add(survivor, other, count)
            self.edges.pop(place, None)

    def keyframe_placed(self, run: int, keyframe_id: int, place: int) -> None:
        """A keyframe that had no place, perhaps because it is new, has one."""
        placed = self.placed.get(run)
        if placed is None:
            placed = self.placed[run] = SortedKeys()
        joined_before, joined_after = placed.add(keyframe_id, place)
        before = place if joined_before is None else self._find(joined_before)
        after = place if joined_after is None else self._find(joined_after)
        if joined_before is not None and joined_after is not None and before != after:
            self._add(before, after, -1)
        if before != place:
            self._add(before, place, 1)
        if after != place:
            self._add(place, after, 1)

    def settle(self, offset: Offset) -> list[PlacesLinked]:
        """The edges whose count is another than when last asked, ascending."""
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
        """Everything, for a snapshot: the same for equal states, whichever way they came about."""
        columns = {run: placed.columns() for run, placed in sorted(self.placed.items())}
        edges = [[a, b, n] for a, row in self.edges.items() for b, n in row.items() if a < b]
        return {
            "placed": [[run, len(keys)] for run, (keys, _) in columns.items()],
            "keys": np.array([k for keys, _ in columns.values() for k in keys], np.int64),
            "labels": np.array([p for _, labels in columns.values() for p in labels], np.int32),
            "survivors": sorted(map(list, self.survivors.items())),
            "edges": sorted(edges),
        }

    def load(self, state: State) -> None:
        """Take over what `dump` gave."""
        start = 0
        for run, count in state["placed"]:
            keys = array("q", state["keys"][start : start + count].tobytes())
            labels = array("i", state["labels"][start : start + count].tobytes())
            self.placed[run] = SortedKeys.of(keys, labels)
            start += count
        self.survivors = dict(state["survivors"])
        for a, b, transitions in state["edges"]:
            self.edges.setdefault(a, {})[b] = transitions
            self.edges.setdefault(b, {})[a] = transitions

    def _find(self, place: int) -> int:
        survivors = self.survivors
        while place in survivors:
            above = survivors[place]
            if above in survivors:
                survivors[place] = survivors[above]
            place = above
        return place

    def _add(self, a: int, b: int, change: int) -> None:
        count = self.edges.get(a, {}).get(b, 0)
        self._before.setdefault((a, b) if a < b else (b, a), count)
        for one, other in ((a, b), (b, a)):
            edges = self.edges.setdefault(one, {})
            if count + change:
                edges[other] = count + change
            else:
                edges.pop(other, None)
