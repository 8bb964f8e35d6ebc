"""Answers about the map at a moment: its history as arrays, and its digest."""

import shlex
from time import perf_counter
from typing import Any

from starlette.datastructures import QueryParams

from eventsrc.envelope import Offset
from projections.model.digest import map_digest

from .binary import packed_arrays
from .columns import history_columns
from .log_map import LogMap
from .requests import assignments_of, number_of, text_of


def history_answer(shown: LogMap, query: QueryParams, refold_s: float) -> bytes:
    """The columns of the map as known at ``known_at`` (default: now), from ``from`` on."""
    known_at = _known_at(shown, query, shown.through)
    known = shown.known(shown.through, known_at)
    started = perf_counter()
    history = known.history
    refold_s += perf_counter() - started
    header, columns = history_columns(
        history, Offset(number_of(query, "from", 0)), shown.log_events
    )
    header |= {
        "state": shown.key,
        "known_at": known_at,
        "settings": known.settings.by_name(),
        "refold_ms": round(refold_s * 1e3, 1),
    }
    return packed_arrays(header, columns)


def digest_answer(shown: LogMap, query: QueryParams) -> dict[str, Any]:
    """The digest at W, under the commands known at W or at ``known_at``, as ``state --at W``."""
    end, known_at = moment(shown, query)
    digest = map_digest(shown.known(end, known_at).at(end))
    return {
        "at": end,
        "known_at": known_at,
        "digest": digest,
        "command": command(shown, query, "state", "--at", end, "--digest", known=(end, known_at)),
    }


def moment(shown: LogMap, query: QueryParams) -> tuple[Offset, Offset]:
    """W of ``at`` (default: the end), and ``known_at``, by default W."""
    end = shown.point(text_of(query, "at", "end"))
    return end, _known_at(shown, query, end)


def _known_at(shown: LogMap, query: QueryParams, default: Offset) -> Offset:
    return shown.point(text_of(query, "known_at", str(default)))


def command(
    shown: LogMap,
    query: QueryParams,
    name: str,
    *arguments: object,
    known: tuple[Offset, Offset] | None = None,
) -> str:
    """The command line that gives the same answer. ``known`` are W and ``known_at``, which is named
    where it is not W."""
    words = ["mapfold", name, str(shown.reader.path), *map(str, arguments)]
    if known is not None and known[0] != known[1]:
        words += ["--known-at", str(known[1])]
    for text in assignments_of(query):
        words += ["--set", text]
    return shlex.join(words)
