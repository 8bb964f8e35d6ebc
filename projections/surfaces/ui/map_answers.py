"""Answers about the map at a moment: its history as arrays, its rooms, its digest, its walls.

From the arrays the page computes the map at any offset. They are made of the columns of a
`History`; nothing is folded here. Ordinals of keyframes, places and objects are those of the fold:
rows 0, 1, 2 … of ``kf_``, ``pf_`` and ``of_``. Objects have a row for each event that changed one,
with all values of the object after it. With a ``start``, rows of earlier events are left out;
numbers stay the same, so that a client can append the rows to those it has.
"""

from collections.abc import Sequence
from time import perf_counter
from typing import Any, Final

import numpy as np
from starlette.datastructures import QueryParams

from eventsrc.base.text import counted, visible
from eventsrc.envelope.model import Offset
from projections.ask.room_and_path import rooms
from projections.fold.exact import UM_PER_M, mean_m
from projections.fold.map_errors import QuestionError
from projections.fold.settings import Settings
from projections.history.names import keyframe_name
from projections.map.digest import map_digest
from projections.map.place_regions import place_regions, wall_segments
from projections.map.state_output import LEAST_POSES, state_camera
from projections.map.view import MapView
from projections.store.columns import NONE, Array
from projections.store.history import History
from projections.store.object_states import ObjectStates
from projections.store.tables import Tables

from .log_events import LogEvents, event_columns
from .log_map import LogMap
from .requests import AskedPoint, command_line, number_of, packed_arrays, text_of

_UM2_PER_M2: Final = float(UM_PER_M) ** 2
_INT32_MAX: Final = 2**31 - 1
_NEAR_M: Final = 4096.0
"""Distance from the origin within which a float32 is exact to half a millimetre."""
_ORIGIN_STEP_M: Final = 1000.0


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
    """The digest at W under the commands known at W or at ``known_at``, as in ``state --at W``."""
    asked = AskedPoint.of(shown, query)
    return {
        **asked.document(),
        "digest": map_digest(asked.known.at(asked.end)),
        "command": asked.command("state", "--digest"),
    }


def overview_answer(shown: LogMap, query: QueryParams) -> dict[str, Any]:
    """The rooms of the map at W as `projections.ask` lists them, each with the likeliest types and,
    where walls are known, its region; and what is ``odd`` about the map, as sentences with the
    command that helps."""
    asked = AskedPoint.of(shown, query)
    view = asked.known.at(asked.end)
    ordinals = {record.place_id: place for place, record in view.places.items()}
    regions = view.once(place_regions)
    listed = list[dict[str, Any]]()
    for each in rooms(view):
        place = ordinals[each.place_id]
        kind, region = view.type_of(place), regions.get(place)
        listed.append(
            {
                **each.document(),
                "candidates": [] if kind is None else kind.candidates,
                "region": None if region is None else region.document()["region"],
            }
        )
    command = asked.command("state")
    return {
        **asked.document(),
        "rooms": listed,
        "odd": _odd(shown, view),
        "crops": shown.crops.are_kept,
        "command": command,
    }


def _odd(shown: LogMap, view: MapView) -> list[dict[str, str]]:
    """What stands out, ``says``, and the ``command`` that helps."""
    settings, found = view.settings, list[dict[str, str]]()

    def help_by(says: str, command: str) -> None:
        found.append({"says": says, "command": command})

    counts = view.counts()
    if unstated := counts.get("without_camera", 0):
        camera = settings.camera.constants
        help_by(
            f"No camera is stated for {counted(unstated, 'keyframe')}: boxes are read as if of"
            f" {camera.hfov_deg:g}° and {camera.width_px:g} × {camera.height_px:g} pixels.",
            visible(state_camera(shown.opened.log)),
        )
    if counts["poses"] >= LEAST_POSES and counts["places"] == 1:
        is_full = settings.places == "rooms"
        change = f"rooms.drive_m={settings.rooms.drive_m / 2:g}" if is_full else "preset=full"
        help_by(
            "All is one place. If that is more than one room, other settings tell them apart.",
            command_line(shown.opened, "whatif", "--set", change),
        )
    if settings.places == "rooms" and counts["poses"] and not view.maps:
        help_by(
            "No walls are known: places have neither outlines nor areas.",
            command_line(shown.opened, "import", "--map", "map.yaml"),
        )
    names = settings.changed_from(Settings())
    is_calibrated = any(name.startswith(("evidence.", "localizer.")) for name in names)
    if settings.fusion == "evidence" and counts["objects"] and not is_calibrated:
        help_by(
            "Nothing is calibrated: constants of other robots decide what is one object.",
            command_line(shown.opened, "calibrate", "--write"),
        )
    return found


def walls_answer(shown: LogMap, query: QueryParams) -> dict[str, Any]:
    """The walls of an occupancy map, by its number in ``maps`` of the log's document."""
    maps = shown.timeline.history.maps
    number = number_of(query, "number", 0)
    if number >= len(maps):
        raise QuestionError(f"there is no occupancy map {number}; the log has {len(maps)}")
    return {"number": number, "walls": wall_segments(maps[number].map)}


def history_columns(
    history: History, start: Offset, log_events: LogEvents
) -> tuple[dict[str, Any], dict[str, Array]]:
    """The header and the columns of everything that the events from ``start`` on did.

    ``strings`` of the header are those that are new since ``start``; ``first`` says how many there
    were before. Positions are metres from ``origin``, which is (0, 0) unless the map is so far off
    that float32 would be too coarse.
    """
    rows = _Since(history.tables, start)
    origin = map_origin(history.tables)
    classes = _class_names(history.tables)
    ids = history.tables.integers("keyframe", "keyframe_id")
    number_is_id = not len(ids) or bool(ids.min() >= 0 and ids.max() <= _INT32_MAX)
    floors, floor_names = _numbered(*history.tables.codes("keyframe", "floor"))
    events, event_header = event_columns(history, start, log_events)
    header = {
        "from": start,
        "through": history.next_offset,
        "origin": list(origin),
        "first": {
            "keyframe": rows.first("keyframe"),
            "place_id": rows.first("formed"),
            "object_id": rows.first("found"),
            "refusals": rows.first("refused"),
            "system": log_events.count_before(start),
        },
        "strings": {
            "place_id": rows.texts("formed", "place_id"),
            "place_founder": [
                keyframe_name(history, founder) for founder in rows.of("formed", "founder").tolist()
            ],
            "object_id": rows.texts("found", "object_id"),
            "class": classes,
            "run_id": [seen[0].run_id for seen in history.runs],
            "floor": floor_names,
        },
        "names": [
            {"offset": each.offset, "place": each.place, "name": each.name}
            for each in history.tables.deltas("named", rows.first("named"))
        ],
        "kf_number_is_id": number_is_id,
    }
    columns = {
        **_keyframe_columns(rows, origin, number_is_id=number_is_id),
        "kf_floor": floors[rows.first("keyframe") :],
        **_place_columns(history, rows),
        **_object_columns(history.tables, start, classes, origin),
        **_adjacency_columns(rows),
        **events,
    }
    return header | event_header, columns


class _Since:
    """The rows of tables that the events from ``start`` on added."""

    def __init__(self, tables: Tables, start: Offset) -> None:
        self.tables, self._start = tables, start

    def first(self, table: str) -> int:
        """The number of rows before."""
        return self.tables.before(table, self._start)

    def of(self, table: str, column: str) -> Array:
        return self.tables.column(table, column)[self.first(table) :]

    def texts(self, table: str, column: str) -> list[str | None]:
        return self.tables.texts(table, column, self.first(table), self.tables.count(table))

    def named(self, table: str, **columns: str) -> dict[str, Array]:
        """Columns of int32 by the name that they have here."""
        return {name: self.of(table, column).astype("<i4") for name, column in columns.items()}


def map_origin(tables: Tables) -> tuple[float, float]:
    """The origin of positions in metres: (0, 0), or a point near the first pose if that is far
    off."""
    posed = np.flatnonzero(tables.column("keyframe", "pose"))
    if not len(posed):
        return 0.0, 0.0
    x, y = (int(tables.column("keyframe", each)[posed[0]]) / UM_PER_M for each in ("x_um", "y_um"))
    if max(abs(x), abs(y)) <= _NEAR_M:
        return 0.0, 0.0
    return round(x / _ORIGIN_STEP_M) * _ORIGIN_STEP_M, round(y / _ORIGIN_STEP_M) * _ORIGIN_STEP_M


def _class_names(tables: Tables) -> list[str]:
    """The classes that objects have had, in the order of their first events, those found before
    those classified, so that a longer history only adds names at the end."""
    first: dict[str, tuple[int, int, int]] = {}
    for rank, table in enumerate(("found", "classified")):
        codes, strings = tables.codes(table, "class_name")
        offsets = tables.integers(table, "offset")
        unique, rows = np.unique(codes, return_index=True)
        for code, row in zip(unique.tolist(), rows.tolist(), strict=True):
            seen = int(offsets[row]), rank, row
            first[strings[code]] = min(seen, first.get(strings[code], seen))
    return sorted(first, key=first.__getitem__)


def _numbered(codes: Array, strings: Sequence[str]) -> tuple[Array, list[str]]:
    """Texts numbered by their first row, -1 for none, and the texts in that order."""
    names: dict[str, int] = {}
    unique, first, inverse = np.unique(codes, return_index=True, return_inverse=True)
    numbers = np.full(len(unique), NONE, "<i4")
    for place in np.argsort(first).tolist():
        if unique[place] != NONE:
            numbers[place] = names.setdefault(strings[unique[place]], len(names))
    return numbers[inverse], list(names)


def _keyframe_columns(
    rows: _Since, origin: tuple[float, float], *, number_is_id: bool
) -> dict[str, Array]:
    table = "keyframe"
    ids = rows.of(table, "keyframe_id")
    first = rows.first(table)
    places = {"kf_x": ("x_um", origin[0]), "kf_y": ("y_um", origin[1])}
    where = {
        name: (rows.of(table, column) / UM_PER_M - shift).astype("<f4")
        for name, (column, shift) in places.items()
    }
    where["kf_yaw"] = rows.of(table, "yaw_rad").astype("<f4")
    for values in where.values():
        values[rows.of(table, "pose") == 0] = np.nan
    return {
        **rows.named(table, kf_offset="offset", kf_run="run"),
        **where,
        "kf_stamp": rows.of(table, "timestamp").astype("<f8"),
        "kf_number": (ids if number_is_id else np.arange(first, first + len(ids))).astype("<i4"),
        "kf_id": ids.astype("<i8"),
    }


def _place_columns(history: History, rows: _Since) -> dict[str, Array]:
    placed = rows.named("placed", pl_offset="offset", pl_keyframe="keyframe", pl_place="place")
    order = np.lexsort((placed["pl_keyframe"], placed["pl_offset"]))
    formed = rows.named("formed", pf_offset="offset", pf_founder="founder")
    first = rows.first("formed")
    merged = [
        (merge.cause.offset, merge.survivor, place, merge.bridge)
        for merge in history.merges[rows.first("merge") :]
        for place in merge.absorbed
    ]
    return {
        **{name: column[order] for name, column in placed.items()},
        "pf_offset": formed["pf_offset"],
        "pf_place": np.arange(first, first + len(formed["pf_offset"]), dtype="<i4"),
        "pf_founder": formed["pf_founder"],
        **_by_name(("mg_offset", "mg_survivor", "mg_absorbed", "mg_keyframe"), merged),
    }


def _adjacency_columns(rows: _Since) -> dict[str, Array]:
    """By event, and within one by the pair that was adjacent first."""
    a, b = (rows.tables.integers("linked", each) for each in ("a", "b"))
    _, first, pair = np.unique(a << 32 | b, return_index=True, return_inverse=True)
    names = {"ad_a": "a", "ad_b": "b", "ad_count": "shared_transitions"}
    columns = rows.named("linked", ad_offset="offset", **names)
    order = np.lexsort((first[pair][rows.first("linked") :], columns["ad_offset"]))
    return {name: column[order] for name, column in columns.items()}


def _object_columns(
    tables: Tables, start: Offset, classes: Sequence[str], origin: tuple[float, float]
) -> dict[str, Array]:
    """The columns of objects, of their changes and of their merges."""
    rows, states = _Since(tables, start), ObjectStates.since(tables, start)
    numbers = {name: number for number, name in enumerate(classes)}
    found = rows.texts("found", "class_name")
    first = rows.first("found")
    has_estimate = states.has("estimated")
    columns: dict[str, Array] = {
        "of_offset": rows.of("found", "offset").astype("<i4"),
        "of_object": np.arange(first, first + len(found), dtype="<i4"),
        "of_class": np.array([numbers[name or ""] for name in found], "<i4"),
        "oc_offset": (states.ends - 1).astype("<i4"),
        "oc_object": states.objects.astype("<i4"),
    }
    counts = states.values["obs_count"].tolist()
    for axis, shift in zip("xy", origin, strict=True):
        sums = states.values[f"sum_{axis}_um"].tolist()
        mean = np.array(list(map(mean_m, sums, counts)), "<f8")
        estimate = states.of("estimated", f"{axis}_um") / UM_PER_M
        columns[f"oc_{axis}"] = (np.where(has_estimate, estimate, mean) - shift).astype("<f4")
    for name in ("xx", "xy", "yy"):
        variance = states.of("estimated", f"var_{name}_um2") / _UM2_PER_M2
        columns[f"oc_{name}"] = np.where(has_estimate, variance, np.nan).astype("<f4")
    return {
        **columns,
        "oc_count": np.array(counts, "<i4"),
        "oc_class": np.array([numbers[name] for name in states.class_names], "<i4"),
        "oc_place": states.of("moved", "place", NONE).astype("<i4"),
        "oc_missing": states.is_missing.astype("|u1"),
        "oc_confirmed": states.is_confirmed.astype("|u1"),
        **rows.named("fused", om_offset="offset", om_survivor="survivor", om_absorbed="absorbed"),
    }


def _by_name(names: Sequence[str], rows: Sequence[Sequence[int]]) -> dict[str, Array]:
    """A column of int32 for each name, from rows in the order of the names."""
    table = np.array(rows, "<i4").reshape(-1, len(names))
    return {name: np.ascontiguousarray(table[:, i]) for i, name in enumerate(names)}
