"""Parameters of questions, and refusals as JSON."""

from collections.abc import Mapping
from typing import Any, Final

from starlette.datastructures import QueryParams

from eventsrc.base.errors import LogError, MapfoldError, MisuseError
from eventsrc.base.text import visible_lines
from projections.fold.errors import DatabaseError, LogPointError, QuestionError, SettingsError
from projections.history import ExpressionError, NoSuchThing
from projections.surfaces.serve.answering import TooMuchError

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
    ``min_samples``, in the order of their names."""
    found = query.getlist("set")
    found += [f"{name}={query[name]}" for name in ("eps_m", "min_samples") if query.get(name)]
    if len(found) > MOST_SETS:
        raise SettingsError(f"{len(found)} settings are changed; at most {MOST_SETS} can be")
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
