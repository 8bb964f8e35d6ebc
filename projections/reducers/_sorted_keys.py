"""Sorted integers with a label each, cheap to add to in any order.

Blocks of at most 2,048 keys: adding in order appends to the last one, adding out of order moves at
most one block's worth of memory. No key is ever added twice or removed.
"""

from array import array
from bisect import bisect_right

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
