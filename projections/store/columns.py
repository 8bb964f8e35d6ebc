"""The changes of a history as columns: tables of numbers and texts, rows in order of events.

There is a table for each kind of delta, with columns for its fields, which are read from the
struct itself. A field that is a struct or a tuple has a column for each part; a struct that may be
None has a flag of its own name before them. The ordinal of a new thing is the number of its row,
and an embedding is kept as its checksum.

A `Stripe` has the rows of a span of events. Rows are only ever added, so the map after any number
of events is made from the first rows of each table, and a log that has grown adds a stripe.

Kinds of columns: ``int``, ``number?`` (an integer of 0 or more, -1 for none), ``int?`` (any
integer, the least of 64 bits for none), ``float``, ``flag``, ``code`` (a text that repeats, as its
index in the stripe's own ``strings``, -1 for none) and ``text``. Integers take the fewest bytes
that hold all of a stripe; a text is its UTF-8 bytes and, in the array ``NAME/ends``, where each
ends.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from operator import attrgetter
from typing import Any, Final, Literal, TypeAlias, cast

import msgspec
import numpy as np
from msgspec import inspect
from numpy.typing import NDArray

from eventsrc.base.machine import crc32
from eventsrc.envelope.model import Offset
from projections.fold import deltas

Kind = Literal["int", "number?", "int?", "float", "flag", "code", "text"]
Array: TypeAlias = NDArray[Any]
Table: TypeAlias = dict[str, Kind]
Row: TypeAlias = tuple[Any, ...]

NONE: Final = -1
"""The value of ``number?`` and ``code`` for None."""
NO_INT: Final = -(1 << 63)
"""The value of ``int?`` for None."""

_NOTHING: Final[Mapping[Kind, int]] = {"number?": NONE, "int?": NO_INT}

DELTAS: Final[Mapping[str, type[msgspec.Struct]]] = {
    "run": deltas.RunSeen,
    "joined": deltas.FrameJoined,
    "keyframe": deltas.KeyframeAdded,
    "observation": deltas.ObservationAdded,
    "skipped": deltas.EventSkipped,
    "formed": deltas.PlaceFormed,
    "placed": deltas.KeyframePlaced,
    "changed": deltas.PlaceChanged,
    "named": deltas.PlaceNamed,
    "refused": deltas.MergeRefused,
    "linked": deltas.PlacesLinked,
    "found": deltas.ObjectFound,
    "seen": deltas.ObjectSeen,
    "fused": deltas.ObjectsMerged,
    "estimated": deltas.ObjectEstimated,
    "classified": deltas.ObjectClassified,
    "missing": deltas.ObjectMissing,
    "relocated": deltas.ObjectRelocated,
    "moved": deltas.ObjectMoved,
}
_ORDINALS: Final = {
    "keyframe": "keyframe",
    "observation": "observation",
    "formed": "place",
    "found": "object",
}
"""The field that is the number of the row."""
_LEFT_OUT: Final = {
    "observation": ("run_id", "keyframe_id"),  # those of its keyframe
}
_SIGNED: Final = ("similarity_q40", "z_um")
"""Optional integers that may be negative."""
_PREFIXED: Final = ("camera", "body")
"""The fields with parts of the same name as another field's: theirs have the field's before it."""
_UNIQUE: Final = ("det_id", "place_id", "object_id")
_SCALARS: Final[Mapping[type, Kind]] = {
    inspect.IntType: "int",
    inspect.FloatType: "float",
    inspect.BoolType: "flag",
    inspect.StrType: "code",
    inspect.LiteralType: "code",
}


class _Field:
    """A field of a delta as columns. ``model`` is the struct that it is, if it is one."""

    def __init__(self, field: inspect.Field) -> None:
        self.name = field.name
        types = field.type.types if isinstance(field.type, inspect.UnionType) else (field.type,)
        self.optional = len(types) > 1
        (type_,) = (each for each in types if not isinstance(each, inspect.NoneType))
        self.model: Callable[..., Any] | None = None
        if isinstance(type_, inspect.StructType):
            self.model = type_.cls
            self.columns = _table_of(map(_Field, type_.fields))
            if self.name in _PREFIXED:
                self.columns = {f"{self.name}_{part}": k for part, k in self.columns.items()}
            self._nothing = (0,) * (1 + len(self.columns))
            if self.optional:
                self.columns = {self.name: "flag", **self.columns}
        elif isinstance(type_, inspect.TupleType):
            kinds = enumerate(_SCALARS[type(each)] for each in type_.item_types)
            self.columns = {f"{self.name}{number}": kind for number, kind in kinds}
        elif isinstance(type_, inspect.CustomType):
            self.columns = {"crc": "number?"}
        else:
            kind = _SCALARS[type(type_)]
            if self.optional and kind == "int":
                kind = "int?" if self.name in _SIGNED else "number?"
            elif not self.optional and self.name in _UNIQUE:
                kind = "text"
            self.columns = {self.name: kind}
        self.is_scalar = list(self.columns) == [self.name]

    def parts(self) -> Callable[[Any], Row]:
        """The function that makes the columns of a value that is not a scalar."""
        if self.model is None:
            return _whole if len(self.columns) > 1 else _checksum
        nothing, astuple = self._nothing, msgspec.structs.astuple
        if not self.optional:
            return astuple
        return lambda value: nothing if value is None else (1, *astuple(value))

    def made(self, columns: list[list[Any]]) -> Iterable[Any]:
        """The values made of columns."""
        if self.model is None:
            return columns[0] if self.is_scalar else zip(*columns, strict=True)
        if not self.optional:
            return map(self.model, *columns)
        there, *parts = columns
        made = map(self.model, *parts)
        return (each if is_there else None for each, is_there in zip(made, there, strict=True))


def _whole(value: Row) -> Row:
    return value


def _checksum(vector: Array | None) -> Row:
    return (None if vector is None else crc32(vector.data),)


def _table_of(fields: Iterable[_Field]) -> Table:
    return {name: kind for field in fields for name, kind in field.columns.items()}


def _fields_of(table: str, delta: type[msgspec.Struct]) -> list[_Field]:
    """The fields that are kept, scalars first."""
    left_out = (_ORDINALS.get(table), *_LEFT_OUT.get(table, ()))
    whole = cast("inspect.StructType", inspect.type_info(delta))
    fields = [_Field(field) for field in whole.fields if field.name not in left_out]
    return sorted(fields, key=lambda field: not field.is_scalar)


_FIELDS: Final = {table: _fields_of(table, delta) for table, delta in DELTAS.items()}
TABLES: Final[dict[str, Table]] = {
    **{table: _table_of(fields) for table, fields in _FIELDS.items()},
    "merge": {"offset": "int", "document": "text"},
    "map": {"offset": "int", "document": "code"},
}
"""The columns of each table by name. Merges of places, with all that they moved, are documents, and
so are maps made of scans; a map without one is read from the log."""


def _row_maker(fields: Sequence[_Field]) -> Callable[[Any], Row]:
    """The function that makes the row of a delta with these fields."""
    names = [field.name for field in fields if field.is_scalar]
    compound = [field for field in fields if not field.is_scalar]
    if len(names) == 1:
        return lambda delta: (getattr(delta, names[0]),)
    scalars = attrgetter(*names)
    if not compound:
        return scalars

    makers = [(attrgetter(field.name), field.parts()) for field in compound]

    def row(delta: Any) -> Row:
        found: Row = scalars(delta)
        for value_of, parts_of in makers:
            found += parts_of(value_of(delta))
        return found

    return row


ROWS: Final[Mapping[type, tuple[str, Callable[[Any], Row]]]] = {
    **{delta: (table, _row_maker(_FIELDS[table])) for table, delta in DELTAS.items()},
    deltas.MapGiven: (
        "map",
        lambda given: (given.offset, given.map.encode().decode() if given.scanned else None),
    ),
}
"""The table of each kind of delta, and the function that makes its row."""


def deltas_of(table: str, columns: Iterable[list[Any]], numbers: Iterable[int]) -> list[Any]:
    """The deltas of rows with these columns and numbers."""
    rest = iter(columns)
    values = {
        field.name: field.made([next(rest) for _ in field.columns]) for field in _FIELDS[table]
    }
    if table in _ORDINALS:
        values[_ORDINALS[table]] = numbers
    delta = DELTAS[table]
    return list(map(delta, *(values[name] for name in delta.__struct_fields__)))


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

    def texts(self, table: str, column: str, rows: slice | Array) -> list[str | None]:
        """The texts of some rows."""
        name = f"{table}.{column}"
        if TABLES[table][column] != "text":
            strings = [*self.strings, None]  # so that NONE, -1, is None
            return [strings[code] for code in self.arrays[name][rows].tolist()]
        if isinstance(rows, slice):
            return list(texts_in(self.arrays, name, rows.start, rows.stop))
        return [texts_in(self.arrays, name, row, row + 1)[0] for row in rows.tolist()]

    def lists(self, table: str, rows: slice | Array) -> Iterator[list[Any]]:
        """Each column of some rows."""
        for column, kind in TABLES[table].items():
            if kind in ("text", "code"):
                yield self.texts(table, column, rows)
                continue
            array = self.arrays[f"{table}.{column}"][rows]
            values: list[Any] = (array.astype(np.bool_) if kind == "flag" else array).tolist()
            if kind in _NOTHING:
                nothing = _NOTHING[kind]
                values = [None if value == nothing else value for value in values]
            yield values


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
    elif kind in _NOTHING:
        nothing = _NOTHING[kind]
        values = [nothing if value is None else value for value in values]
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
