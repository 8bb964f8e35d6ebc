"""What a reducer hands to a snapshot: named values, each a numpy array or JSON.

What a reducer hands to a snapshot: named values, each a numpy array or JSON.
"""

from typing import Any, TypeAlias

State: TypeAlias = dict[str, Any]


def prefixed(name: str, state: State) -> State:
    """The same values as ``name.key``, to put several states into one."""
    return {f"{name}.{key}": value for key, value in state.items()}


def part(name: str, state: State) -> State:
    """What `prefixed` put in under ``name``."""
    start = f"{name}."
    return {key.removeprefix(start): v for key, v in state.items() if key.startswith(start)}
