"""Answers about the map at a moment: its history as arrays, and its digest."""

from time import perf_counter
from typing import Any

from starlette.datastructures import QueryParams

from eventsrc.envelope.model import Offset
from projections.fold.errors import QuestionError
from projections.map.digest import map_digest
from projections.map.view import MapView
from projections.map.wall_segments import wall_segments

from .binary import packed_arrays
from .columns import history_columns
from .log_map import LogMap
from .moment import Moment
from .requests import number_of, text_of


def history_answer(shown: LogMap, query: QueryParams, refold_s: float) -> bytes:
    """The columns of the map as known at ``known_at`` (default: now), from ``from`` on."""
    known_at = shown.point(text_of(query, "known_at", "end"))
    known = shown.timeline.knowing(known_at)
    started = perf_counter()
    history = known.history
    refold_s += perf_counter() - started
    start = Offset(number_of(query, "from", 0))
    key = shown.key, shown.through, known_at
    if start == 0 and shown.packed is not None and shown.packed[0] == key:
        return shown.packed[1]
    header, columns = history_columns(history, start, shown.log_events)
    header |= {
        "state": shown.key,
        "known_at": known_at,
        "settings": known.settings.by_name(),
        "refold_ms": round(refold_s * 1e3, 1),
    }
    answer = packed_arrays(header, columns)
    if start == 0:
        shown.packed = key, answer
    return answer


def digest_answer(shown: LogMap, query: QueryParams) -> dict[str, Any]:
    """The digest at W under the commands known at W or at ``known_at``, as in ``state --at W``, and
    the type of each place."""
    moment = Moment.of(shown, query)
    view = moment.known.at(moment.end)
    return {
        **moment.document(),
        "digest": map_digest(view),
        "types": _types(view),
        "command": moment.command("state", "--digest"),
    }


def _types(view: MapView) -> list[dict[str, Any]]:
    """For each place with evidence of its type: the type (None where unsure), its probability, and
    the likeliest types."""
    found = ((place.place_id, view.type_of(place.ordinal)) for place in view.places.values())
    return [
        {
            "place_id": place_id,
            "type": each.type,
            "probability": each.probability,
            "candidates": each.candidates,
        }
        for place_id, each in found
        if each is not None
    ]


def walls_answer(shown: LogMap, query: QueryParams) -> dict[str, Any]:
    """The walls of an occupancy map, by its number in ``maps`` of the log's document."""
    maps = shown.timeline.history.maps
    number = number_of(query, "number", 0)
    if number >= len(maps):
        raise QuestionError(f"there is no occupancy map {number}; the log has {len(maps)}")
    return {"number": number, "walls": wall_segments(maps[number].map)}
