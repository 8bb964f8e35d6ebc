"""The Places and Objects of a `Map`: dictionaries of ``mapfold state --json`` whose keys are
attributes, too, and lists of them that become a table of pandas."""

from collections.abc import Iterable
from typing import Any, TypeVar

from eventsrc.base.errors import MisuseError
from eventsrc.base.text import visible

_MOST_SHOWN = 3


class _Thing(dict[str, Any]):
    def __getattr__(self, name: str) -> Any:
        if name in self:
            return self[name]
        if name in type(self).__annotations__:
            return None
        raise AttributeError(f"no {name!r} here; there are {', '.join(self)}")


class KnownPlace(_Thing):
    """A Place, in metres. Unknown values, such as the name of an unnamed Place, are None."""

    place_id: str
    centroid_x: float
    centroid_y: float
    keyframe_count: int
    name: str | None
    type: str | None
    type_probability: float | None
    floor: str | None
    area_m2: float | None

    def __repr__(self) -> str:
        word = self.name or self.type
        called = visible(self.place_id if word is None else f"{self.place_id} {word}")
        return f"<{called} around ({self.centroid_x:.2f}, {self.centroid_y:.2f})>"


class KnownObject(_Thing):
    """An Object, in metres. Unknown values, such as an estimated position, are None."""

    object_id: str
    class_name: str
    mean_x: float
    mean_y: float
    obs_count: int
    place_id: str | None
    first_seen: float
    last_seen: float
    det_ids: list[str]
    est_x: float | None
    est_y: float | None
    est_sigma_m: float | None
    confirmed: bool | None

    def __repr__(self) -> str:
        x, y = (self.mean_x, self.mean_y) if self.est_x is None else (self.est_x, self.est_y)
        seen = f"seen {self.obs_count:,}×"
        return f"<{visible(self.class_name)} {self.object_id} at ({x:.2f}, {y:.2f}), {seen}>"


_T = TypeVar("_T", bound=_Thing)


class KnownThings(list[_T]):
    """Things in their order."""

    @classmethod
    def of(cls, kind: type[_T], rows: Iterable[dict[str, Any]]) -> "KnownThings[_T]":
        """Rows as things of a kind."""
        return cls(kind(row) for row in rows)

    def to_pandas(self) -> Any:
        """A pandas DataFrame with a row for each. Raises MisuseError where pandas is missing."""
        try:
            import pandas
        except ModuleNotFoundError:
            raise MisuseError(
                "to_pandas needs pandas, which is not installed; pip install pandas"
            ) from None
        return pandas.DataFrame([dict(thing) for thing in self])

    def __repr__(self) -> str:
        more = len(self) - _MOST_SHOWN
        shown = ", ".join(map(repr, self[:_MOST_SHOWN]))
        return f"[{shown}{f', … {more:,} more' if more > 0 else ''}]"
