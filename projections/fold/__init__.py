"""The rules of the map: reducers, pure, without clock, chance, disk, network or database.

What decides that two places merge: `Places._cluster` for places by DBSCAN, `Rooms._merge_all` for
places by rooms; under ``join`` and ``keep-apart`` also `ConstrainedPlaces`. That an observation is
of an Object: `Objects.fold`, or `Matching.choose` by evidence. `semantic_map` runs them all.
"""

from array import array
from collections.abc import MutableSequence
from typing import Any, Final, Literal, TypeAlias

FOLD_VERSION: Final = 16
"""To be raised with every change of the reducers that changes the map of some log: what was kept of
the maps of another version, and databases with them, are made again."""

State: TypeAlias = dict[str, Any]
"""The state of a reducer as it is kept: named values, each a numpy array or JSON."""


def packed(typecode: Literal["i", "q"], content: bytes = b"") -> MutableSequence[Any]:
    """An `array`, for an attribute that is declared as a sequence of ordinals: mypy's type for
    arrays knows plain ints only."""
    return array(typecode, content)


def prefixed(name: str, state: State) -> State:
    """The same values as ``name.key``, to put several states into one."""
    return {f"{name}.{key}": value for key, value in state.items()}


def part(name: str, state: State) -> State:
    """The values that `prefixed` stored under ``name``."""
    start = f"{name}."
    return {key.removeprefix(start): v for key, v in state.items() if key.startswith(start)}
