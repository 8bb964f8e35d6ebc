"""What a question asks, and the form of its answer: parameters, the point in time, the equivalent
command line, refusals and JSON, and arrays.

Arrays are one binary answer: the length of a JSON header in bytes (uint32, little-endian), the
header as UTF-8 JSON, zeros up to the first array, and the arrays in the order of ``arrays`` in the
header. Each array starts at a multiple of 8; its ``offset`` counts bytes from the start of the
answer. All numbers are little-endian, so a browser makes typed arrays of them without copying.
"""

import json
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from starlette.datastructures import QueryParams

from eventsrc.base.errors import LogError, MapfoldError, MisuseError
from eventsrc.base.text import visible_lines
from eventsrc.envelope.model import Offset
from projections.fold.map_errors import DatabaseError, LogPointError, QuestionError, SettingsError
from projections.history import ExpressionError, KnownHistory, NoSuchThing
from projections.map.naming import ShortIds
from projections.store.columns import Array
from projections.surfaces.serve.answering import TooMuchError

from .log_map import LogMap, Opened

DTYPES: Final = {"i8": "<i8", "f8": "<f8", "f4": "<f4", "i4": "<i4", "u4": "<u4", "u1": "|u1"}
"""The types of arrays by the names in the header."""
_NAMES: Final = {np.dtype(code): name for name, code in DTYPES.items()}
_ALIGNED: Final = 8
_LENGTH_BYTES: Final = 4
_OFFSET_DIGITS: Final = 12


def encoded(document: Mapping[str, Any]) -> bytes:
    """Compact UTF-8 JSON; half a surrogate pair, which UTF-8 cannot hold, becomes a question
    mark."""
    return json.dumps(document, ensure_ascii=False, allow_nan=False).encode("utf-8", "replace")


def packed_arrays(header: Mapping[str, Any], columns: Mapping[str, Array]) -> bytes:
    """The binary answer; ``arrays`` is added to the header."""
    # The header names offsets, which depend on its length: room is kept for the longest ones.
    longest = _header(header, columns, 10**_OFFSET_DIGITS)
    start = _aligned(_LENGTH_BYTES + len(longest))
    head = _header(header, columns, start)
    parts = [len(head).to_bytes(_LENGTH_BYTES, "little"), head]
    parts.append(bytes(start - _LENGTH_BYTES - len(head)))
    for column in columns.values():
        parts += (column.tobytes(), bytes(_aligned(column.nbytes) - column.nbytes))
    return b"".join(parts)


def _header(header: Mapping[str, Any], columns: Mapping[str, Array], start: int) -> bytes:
    """The header of arrays that begin at ``start``."""
    placed = []
    for name, column in columns.items():
        dtype = _NAMES[column.dtype]
        placed.append({"name": name, "dtype": dtype, "length": len(column), "offset": start})
        start += _aligned(column.nbytes)
    return encoded({**header, "arrays": placed})


def _aligned(length: int) -> int:
    return -(-length // _ALIGNED) * _ALIGNED


MOST_SETS: Final = 50
_KINDS: Final[tuple[tuple[type[MapfoldError], str, int], ...]] = (
    (TooMuchError, "too_much", 503),
    (NoSuchThing, "not_found", 404),
    (ExpressionError, "bad_condition", 400),
    (LogPointError, "bad_point", 400),
    (SettingsError, "bad_settings", 400),
    (QuestionError, "bad_question", 400),
    (MisuseError, "bad_question", 400),
    (LogError, "log", 500),
    (DatabaseError, "database", 503),
    (MapfoldError, "failed", 500),
)
"""Error, kind and HTTP status; the first that fits."""


def refusal(error: MapfoldError) -> tuple[int, dict[str, Any]]:
    """The HTTP status and the JSON form of an error; that of a condition has its ``column``."""
    for kind, name, status in _KINDS:
        if isinstance(error, kind):
            more = {"column": error.column} if isinstance(error, ExpressionError) else {}
            return status, {"error": {"kind": name, "message": visible_lines(str(error)), **more}}
    raise AssertionError(error)  # the last kind is the base class


def assignments_of(query: QueryParams) -> tuple[str, ...]:
    """The settings that a question changes: ``set=name=value`` and the short forms ``eps_m`` and
    ``min_samples``, in the order of their names. Raises SettingsError, also for a text encoder:
    a client could open any file of this machine by it."""
    found = query.getlist("set")
    found += [f"{name}={query[name]}" for name in ("eps_m", "min_samples") if query.get(name)]
    if len(found) > MOST_SETS:
        raise SettingsError(f"{len(found)} settings are changed; at most {MOST_SETS} can be")
    if any(text.lstrip().startswith("text_encoder") for text in found):
        raise SettingsError("text_encoder names a file; give it to mapfold ui, or to the log")
    return tuple(sorted(found))


def text_of(query: Mapping[str, str], name: str, default: str | None = None) -> str:
    """A parameter. Raises QuestionError when it is missing and has no default."""
    found = query.get(name) or default
    if found is None:
        raise QuestionError(f"{name} is missing; add ?{name}=… to the address")
    return found


def number_of(query: Mapping[str, str], name: str, default: int) -> int:
    """A parameter that is a whole number from 0 on. Raises QuestionError."""
    text = query.get(name) or str(default)
    if not (text.isascii() and text.isdecimal() and len(text) <= 18):
        raise QuestionError(f"{name} is {text[:40]!r}; give a whole number from 0 on")
    return int(text)


@dataclass(frozen=True, slots=True)
class AskedPoint:
    """The map after ``end`` events, under the commands before ``known_at``."""

    shown: LogMap
    query: QueryParams
    end: Offset
    known_at: Offset

    @classmethod
    def of(cls, shown: LogMap, query: QueryParams, name: str = "at") -> "AskedPoint":
        """From the parameters ``at`` (default: the end) and ``known_at`` (default: there)."""
        end = shown.point(text_of(query, name, "end"))
        return cls(shown, query, end, shown.point(text_of(query, "known_at", str(end))))

    @property
    def known(self) -> KnownHistory:
        """The history under the commands before ``known_at``."""
        return self.shown.timeline.knowing(self.known_at)

    @property
    def short_ids(self) -> ShortIds:
        """The short ids of this map, by which its texts name things."""
        return self.known.short_ids(self.end)

    def document(self) -> dict[str, int]:
        """The fields that say which map an answer is about."""
        return {"at": self.end, "known_at": self.known_at}

    def command(self, name: str, *arguments: object, asked_at: bool = True) -> str:
        """The command line that gives the same answer; with ``asked_at`` it has ``--at``."""
        words = [*map(str, arguments)]
        if asked_at:
            words += ["--at", str(self.end)]
        span = sorted((self.end, self.known_at))
        if self.shown.timeline.commands(*span):  # else it is the same map without saying it
            words += ["--known-at", str(self.known_at)]
        settings = self.shown.opened.words(*assignments_of(self.query))
        return command_line(self.shown.opened, name, *words, *settings)


def lines_of(text: str, short_ids: ShortIds) -> list[str]:
    """The lines of a text, as the command prints them."""
    return visible_lines(short_ids.text(text)).splitlines()


def command_line(opened: Opened, name: str, *words: str) -> str:
    """``mapfold NAME LOG …``, quoted for a shell."""
    return shell_line("mapfold", name, str(opened.log), *words)


def shell_line(*words: str) -> str:
    """A command line of printable characters only, for bash and zsh.

    A terminal executes a control character of a pasted line even between quotes: Ctrl-C ends the
    line, and what follows is a command of its own. Characters that change the direction of text
    would display another command. Such a word is written as ``$'…'``.
    """
    return " ".join(map(_quoted, words))


def _quoted(word: str) -> str:
    if word.isprintable():
        return shlex.quote(word)
    return "$'" + "".join(map(_escaped, word)) + "'"


def _escaped(char: str) -> str:
    if char in "'\\":
        return f"\\{char}"
    if char.isprintable():
        return char
    errors = "surrogateescape" if "\udc80" <= char <= "\udcff" else "replace"  # bytes of a path
    return "".join(f"\\{byte:03o}" for byte in char.encode("utf-8", errors))
