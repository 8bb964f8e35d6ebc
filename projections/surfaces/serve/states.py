"""Queries of the map's state: Places or Objects near a position, or all of them in pages.

Near a position they come nearest first. Without one they come in the order in which they were
founded, at most `MAX_PAGE` at a time. A page's ``next`` is the number of its last item: the next
page has those with greater numbers. So while the map changes, an item that exists all the time is
listed exactly once, and new ones come last.
"""

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final, Literal, NamedTuple

from projections.fold.map_errors import QuestionError
from projections.localize.relocalize import describe_value
from projections.postgres.connection import Connection
from projections.postgres.queries import graph_reads

State = Literal["places", "objects"]

DEFAULT_RADIUS_M: Final = 3.0
MAX_METRES: Final = 1e8
"""Ten times as far as a pose may be from the origin."""
DEFAULT_PAGE: Final = 100
MAX_PAGE: Final = 1000
CURSOR: Final = r"^[0-9]{1,14}$"
"""Any such number is a cursor: fewer than the 48 bits of a number in a graphid."""
_NAMES: Final = ("x", "y", "radius", "limit", "cursor")


class _Reads(NamedTuple):
    near: Callable[[Connection, float, float, float], list[dict[str, Any]]]
    after: Callable[[Connection, int, int], graph_reads.Page]


_STATES: Final = {
    "places": _Reads(graph_reads.places_near, graph_reads.places_after),
    "objects": _Reads(graph_reads.objects_near, graph_reads.objects_after),
}


def refuse_unknown(options: Iterable[str], names: Sequence[str]) -> None:
    """Raise QuestionError for an option that is not in ``names``, such as a misspelt one."""
    for name in options:
        if name not in names:
            known = ", ".join(names) or "none"
            raise QuestionError(f"no parameter called {describe_value(name)}; there are {known}")


def state_read(what: str, options: Mapping[str, str]) -> Callable[[Connection], dict[str, Any]]:
    """The read that answers a question about ``what``. Raises QuestionError for an unknown state or
    option."""
    reads = _STATES.get(what)
    if reads is None:
        raise QuestionError(
            f"no state called {describe_value(what)}; there are {' and '.join(_STATES)}"
        )
    refuse_unknown(options, _NAMES)
    if "x" in options or "y" in options:
        return _near(what, reads, options)
    if "radius" in options:
        raise QuestionError(
            "radius is given without x and y; give them too, or leave it out to list all"
        )
    most, after = _limit(options) or DEFAULT_PAGE, _cursor(options)

    def read(connection: Connection) -> dict[str, Any]:
        page = reads.after(connection, after, most)
        return {what: page.things, "next": None if page.after is None else str(page.after)}

    return read


def _near(
    what: str, reads: _Reads, options: Mapping[str, str]
) -> Callable[[Connection], dict[str, Any]]:
    if "cursor" in options:
        raise QuestionError("cursor is given with x and y; it is for lists without a position")
    x, y = _number(options, "x"), _number(options, "y")
    radius = _number(options, "radius", DEFAULT_RADIUS_M)
    if radius < 0:
        raise QuestionError(f"radius is {describe_value(options['radius'])}; give 0 or more metres")
    most = _limit(options)
    return lambda connection: {what: reads.near(connection, x, y, radius)[:most]}


def _number(options: Mapping[str, str], name: str, default: float | None = None) -> float:
    if name not in options and default is None:
        raise QuestionError(f"{name} is missing; give x and y, or neither to list all")
    try:
        value = float(options[name]) if name in options or default is None else default
    except ValueError:
        value = math.nan
    if not abs(value) <= MAX_METRES:  # nor NaN
        raise QuestionError(
            f"{name} is {describe_value(options.get(name))}; give a number of metres"
        )
    return value


def _limit(options: Mapping[str, str]) -> int | None:
    given = options.get("limit")
    if given is None:
        return None
    if not re.fullmatch(r"[0-9]{1,9}", given) or not 1 <= int(given) <= MAX_PAGE:
        raise QuestionError(f"limit is {describe_value(given)}; give a number from 1 to {MAX_PAGE}")
    return int(given)


def _cursor(options: Mapping[str, str]) -> int:
    given = options.get("cursor", "0")
    if not re.fullmatch(CURSOR, given, re.ASCII):
        raise QuestionError(f"cursor is {describe_value(given)}; give next of the previous page")
    return int(given)
