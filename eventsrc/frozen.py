"""Frozen dataclasses that cost little more to build than plain ones.

A frozen dataclass sets each field by a call of ``object.__setattr__``; over the ten deltas of a
keyframe that is a sixth of the whole fold. Here ``__init__`` turns the new instance into an
unfrozen twin of the same layout, sets the fields by plain assignment, and turns it back. From then
on it is as frozen as any: `dataclasses` made it, and the type checker sees a frozen dataclass.
"""

from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields
from functools import partial
from typing import Any, TypeVar, dataclass_transform, overload

T = TypeVar("T")


@overload
def frozen(cls: type[T]) -> type[T]: ...
@overload
def frozen(*, eq: bool = True) -> Callable[[type[T]], type[T]]: ...
@dataclass_transform(frozen_default=True)
def frozen(cls: Any = None, *, eq: bool = True) -> Any:
    """``dataclass(frozen=True, slots=True, eq=eq)``, quick to build. Plain defaults only."""
    if cls is None:
        return partial(frozen, eq=eq)
    made: Any = dataclass(frozen=True, slots=True, eq=eq)(cls)
    made.__init__ = _quick_init(made)
    return made


def _quick_init(made: Any) -> Any:
    """``__init__`` with the fields as parameters, compiled from source as `dataclasses` does."""
    names = [field.name for field in fields(made)]
    defaults = [field.default for field in fields(made) if field.default is not MISSING]
    source = (
        f"def __init__(self, {', '.join(names)}):\n"
        " become(self, '__class__', twin)\n"
        + "".join(f" self.{name} = {name}\n" for name in names)
        + " self.__class__ = made\n"
    )
    twin = type(made.__name__, (), {"__slots__": made.__slots__})
    scope = {"become": object.__setattr__, "twin": twin, "made": made}
    exec(source, scope)  # noqa: S102 - field names of our own classes, nothing from outside
    init: Any = scope["__init__"]
    init.__defaults__ = tuple(defaults)
    init.__qualname__ = f"{made.__qualname__}.__init__"
    return init
