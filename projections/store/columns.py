"""The changes of a history as columns: tables of numbers and texts, rows in order of events.

A `Stripe` has the rows of a span of events. Rows are only ever added, so the map after any number
of events is made from the first rows of each table, and a log that has grown adds a stripe.

Kinds of columns: ``int``, ``number?`` (an integer of 0 or more, -1 for none), ``float``, ``flag``,
``code`` (a text that repeats, as its index in the stripe's own ``strings``, -1 for none) and
``text``. Integers take the fewest bytes that hold all of a stripe; a text is its UTF-8 bytes and,
in the array ``NAME/ends``, where each ends.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from eventsrc.envelope.model import Offset

Kind = Literal["int", "number?", "float", "flag", "code", "text"]
Array: TypeAlias = NDArray[Any]
Table: TypeAlias = dict[str, Kind]

NONE: Final = -1
"""The value of ``number?`` and ``code`` for None."""

_VALUES: Final[Table] = {
    "obs_count": "int",
    "sum_x_um": "int",
    "sum_y_um": "int",
    "first_seen": "float",
    "last_seen": "float",
}
_OBJECT: Final[Table] = {"offset": "int", "object": "int"}

TABLES: Final[dict[str, Table]] = {
    "run": {"offset": "int", "run": "int", "run_id": "code", "started_at": "float"},
    "keyframe": {
        "offset": "int",
        "run": "int",
        "run_id": "code",
        "keyframe_id": "int",
        "timestamp": "float",
        "posed": "flag",
        "x_um": "int",
        "y_um": "int",
        "yaw_rad": "float",
        "floor": "code",
    },
    "observation": {
        "offset": "int",
        "keyframe": "int",
        "det_id": "text",
        "class_name": "code",
        "confidence": "float",
        "x0": "float",
        "y0": "float",
        "x1": "float",
        "y1": "float",
        "model": "code",
        "crc": "number?",
        "foreign": "flag",
    },
    "skipped": {
        "offset": "int",
        "kind": "code",
        "run_id": "code",
        "keyframe_id": "int",
        "det_id": "code",
        "first_offset": "number?",
    },
    "map": {"offset": "int"},
    "formed": {"offset": "int", "place_id": "text", "founder": "int"},
    "placed": {"offset": "int", "keyframe": "int", "place": "int"},
    "changed": {
        "offset": "int",
        "place": "int",
        "keyframe_count": "int",
        "sum_x_um": "int",
        "sum_y_um": "int",
    },
    "named": {"offset": "int", "place": "int", "name": "code", "command": "number?"},
    "merge": {"offset": "int", "document": "text"},
    "refusal": {"offset": "int", "document": "text"},
    "linked": {"offset": "int", "a": "int", "b": "int", "shared_transitions": "int"},
    "found": {
        "offset": "int",
        "object_id": "text",
        "class_name": "code",
        "observation": "int",
    },
    "seen": {**_OBJECT, "observation": "int", "similarity_q40": "int", **_VALUES},
    "object_merge": {"offset": "int", "document": "text"},
    "estimated": {
        **_OBJECT,
        "x_um": "int",
        "y_um": "int",
        "var_xx_um2": "int",
        "var_xy_um2": "int",
        "var_yy_um2": "int",
        "spots": "int",
    },
    "classified": {**_OBJECT, "class_name": "code"},
    "missing": {**_OBJECT, "run": "int", "misses": "int", "missing": "flag"},
    "relocated": {
        **_OBJECT,
        "observation": "int",
        "from_x_um": "int",
        "from_y_um": "int",
        "to_x_um": "int",
        "to_y_um": "int",
    },
    "moved": {**_OBJECT, "place": "number?"},
}
STRINGS: Final = "strings"
"""The array of a stripe's repeated texts."""


def ends_of(name: str) -> str:
    """The name of the array that says where the texts of the column ``name`` end."""
    return f"{name}/ends"


class Stripe:
    """The rows that the events from ``start`` to before ``end`` add.

    ``rows`` is the number of rows of each table that has any, ``arrays`` the columns by
    ``TABLE.COLUMN``. ``release`` drops from memory the arrays that were read from a file.
    """

    def __init__(
        self,
        start: Offset,
        end: Offset,
        rows: Mapping[str, int],
        arrays: Mapping[str, Array],
        release: Callable[[], None] = lambda: None,
    ) -> None:
        self.start, self.end = start, end
        self.rows, self.arrays = rows, arrays
        self.release = release
        self._strings: list[str] | None = None

    @property
    def strings(self) -> list[str]:
        """The texts that codes stand for."""
        if self._strings is None:
            found = STRINGS in self.arrays
            self._strings = texts_in(self.arrays, STRINGS, 0, None) if found else []
        return self._strings

    def text(self, table: str, column: str, row: int) -> str | None:
        """The text of a row."""
        return self.texts(table, column, row, row + 1)[0]

    def texts(self, table: str, column: str, first: int, last: int) -> list[str | None]:
        """The texts of the rows from ``first`` to before ``last``."""
        name = f"{table}.{column}"
        if TABLES[table][column] == "text":
            return list(texts_in(self.arrays, name, first, last))
        strings = [*self.strings, None]  # so that NONE, -1, is None
        return [strings[code] for code in self.arrays[name][first:last].tolist()]


def texts_in(arrays: Mapping[str, Array], name: str, first: int, last: int | None) -> list[str]:
    """The texts ``first`` to before ``last`` of a column of texts."""
    ends = arrays[ends_of(name)]
    start = int(ends[first - 1]) if first else 0
    stops = (ends[first:last].astype(np.int64) - start).tolist()
    raw = arrays[name][start : start + stops[-1] if stops else start].tobytes()
    spans = zip([0, *stops[:-1]], stops, strict=False)
    if raw.isascii():  # then bytes are characters
        text = raw.decode("ascii")
        return [text[a:b] for a, b in spans]
    return [raw[a:b].decode("utf-8", "surrogatepass") for a, b in spans]


def stripe_of(start: Offset, end: Offset, rows: Mapping[str, Sequence[Sequence[Any]]]) -> Stripe:
    """A stripe of these rows, each with the values of its table's columns in order."""
    codes: dict[str, int] = {}
    arrays: dict[str, Array] = {}
    for table, found in rows.items():
        if found:
            columns = zip(*found, strict=True)
            for (column, kind), values in zip(TABLES[table].items(), columns, strict=True):
                arrays |= _arrays(f"{table}.{column}", kind, values, codes)
    if codes:
        arrays |= _text_arrays(STRINGS, codes)
    return Stripe(start, end, {table: len(found) for table, found in rows.items() if found}, arrays)


def _arrays(
    name: str, kind: Kind, values: Sequence[Any], codes: dict[str, int]
) -> dict[str, Array]:
    if kind == "text":
        return _text_arrays(name, values)
    if kind == "float":
        return {name: np.array(values, np.float64)}
    if kind == "flag":
        return {name: np.array(values, np.uint8)}
    if kind == "code":
        values = [NONE if v is None else codes.setdefault(v, len(codes)) for v in values]
    elif kind == "number?":
        values = [NONE if value is None else value for value in values]
    return {name: smallest(_integers(values))}


def _integers(values: Sequence[int]) -> Array:
    try:
        return np.array(values, np.int64)
    except OverflowError:  # sums of positions and variances have no bound
        return np.array(values, object)


def smallest(array: Array) -> Array:
    """The same integers in the fewest bytes each."""
    if array.dtype == object or not len(array):
        return array
    low, high = int(array.min()), int(array.max())
    for dtype in (np.int8, np.int16, np.int32):
        bounds = np.iinfo(dtype)
        if bounds.min <= low and high <= bounds.max:
            return array.astype(dtype)
    return array.astype(np.int64)


def _text_arrays(name: str, texts: Iterable[str]) -> dict[str, Array]:
    encoded = [text.encode("utf-8", "surrogatepass") for text in texts]
    ends = np.cumsum([len(each) for each in encoded], dtype=np.int64)
    joined = np.frombuffer(b"".join(encoded), np.uint8)
    return {name: joined, ends_of(name): smallest(ends)}


def joined(stripes: Sequence[Stripe]) -> Stripe:
    """One stripe made of adjacent stripes, given in order."""
    if len(stripes) == 1:
        return stripes[0]
    codes: dict[str, int] = {}
    recoded = [
        np.array([codes.setdefault(text, len(codes)) for text in each.strings] + [NONE], np.int64)
        for each in stripes
    ]
    rows: dict[str, int] = {}
    arrays: dict[str, Array] = {}
    for table, columns in TABLES.items():
        having = [i for i, each in enumerate(stripes) if each.rows.get(table)]
        if having:
            rows[table] = sum(stripes[i].rows[table] for i in having)
            for column, kind in columns.items():
                name = f"{table}.{column}"
                parts = [stripes[i].arrays[name] for i in having]
                if kind == "code":
                    parts = [recoded[i][part] for i, part in zip(having, parts, strict=True)]
                if kind == "text":
                    ends = [stripes[i].arrays[ends_of(name)] for i in having]
                    arrays[ends_of(name)] = _joined_ends(ends)
                found = np.concatenate(parts)
                arrays[name] = found if kind in ("text", "float", "flag") else smallest(found)
    if codes:
        arrays |= _text_arrays(STRINGS, codes)
    return Stripe(stripes[0].start, stripes[-1].end, rows, arrays)


STRIPE_EVENTS: Final = 65_536
"""Events of a long stripe."""


def joined_short(stripes: Sequence[Stripe]) -> list[Stripe]:
    """The same rows in stripes of at most `STRIPE_EVENTS` events, where stripes are shorter."""
    spans: list[list[Stripe]] = []
    for stripe in stripes:
        if spans and stripe.end - spans[-1][0].start <= STRIPE_EVENTS:
            spans[-1].append(stripe)
        else:
            spans.append([stripe])
    return [joined(span) for span in spans]


def _joined_ends(parts: Sequence[Array]) -> Array:
    bases = np.cumsum([0, *(int(part[-1]) for part in parts)])
    shifted = [p.astype(np.int64) + base for p, base in zip(parts, bases[:-1], strict=True)]
    return smallest(np.concatenate(shifted))
