"""Objects as `projections.ask` finds them, and things by name: places, objects (also by class),
detections, keyframes and runs."""

from collections.abc import Callable, Collection, Iterator, Mapping
from itertools import chain
from typing import Any, Final

from starlette.datastructures import QueryParams

from eventsrc.envelope.model import Offset
from projections.ask.find import Wanted, find
from projections.ask.room_and_path import goal_of, path
from projections.fold.deltas import KeyframeOrdinal, ObjectOrdinal, ObservationOrdinal
from projections.fold.map_errors import QuestionError
from projections.history import NoSuchThing
from projections.history.names import find_keyframe, keyframe_name
from projections.map.naming import matches
from projections.map.records import ObservationRecord
from projections.store.history import History
from projections.surfaces.text_encoders import words_of

from .log_map import LogMap
from .requests import AskedPoint, number_of, text_of

MOST_FOUND: Final = 50
_MOST_TEXT: Final = 300
_NOT: Final = 4
_Found = tuple[int, int, dict[str, Any]]


def _rank(name: str, wanted: str) -> int:
    if wanted not in name:
        return _NOT
    if name == wanted:
        return 0
    tail = name.rpartition("_")[2]
    return 1 if tail == wanted or name.startswith(wanted) else 2 if name.endswith(wanted) else 3


def _places(asked: AskedPoint, _: str) -> Iterator[dict[str, Any]]:
    for place in asked.known.history.places:
        called = [named.name for named in place.names if named.name is not None]
        yield {
            "kind": "place", "id": place.place_id, "number": place.formed.place,
            "offset": place.formed.offset, "stands": place.stands(asked.end),
            "text": place.name(asked.end) or "", "names": [place.place_id, *called],
        }  # fmt: skip


def _objects(asked: AskedPoint, _: str) -> Iterator[dict[str, Any]]:
    history = asked.known.history
    classes = {each.ordinal: each.class_name for each in history.objects_at(asked.end)}
    for each in history.objects:
        class_name = classes.get(each.found.object, each.found.class_name)
        yield {
            "kind": "object", "id": each.object_id, "number": each.found.object,
            "offset": each.found.offset, "stands": each.stands(asked.end), "text": class_name,
            "names": [each.object_id, class_name],
        }  # fmt: skip


def _runs(asked: AskedPoint, _: str) -> Iterator[dict[str, Any]]:
    for number, seen in enumerate(asked.known.history.runs):
        yield {
            "kind": "run", "id": seen[0].run_id, "number": number, "offset": seen[0].offset,
            "stands": seen[0].offset < asked.end, "text": "", "names": [seen[0].run_id],
        }  # fmt: skip


def _keyframes(asked: AskedPoint, wanted: str) -> Iterator[dict[str, Any]]:
    history = asked.known.history
    for keyframe in history.keyframes:
        name = keyframe_name(history, keyframe.keyframe)
        if wanted in name.casefold():
            yield {
                "kind": "keyframe", "id": f"{keyframe.run_id}/{keyframe.keyframe_id}",
                "number": keyframe.keyframe, "offset": keyframe.offset,
                "stands": keyframe.offset < asked.end, "text": "", "names": [name],
            }  # fmt: skip


def _detections(asked: AskedPoint, wanted: str) -> Iterator[dict[str, Any]]:
    history = asked.known.history
    for seen in asked.known.latest.observations:
        if wanted in seen.det_id.casefold():
            keyframe = history.keyframes[seen.keyframe]
            yield {
                "kind": "detection", "id": seen.det_id, "number": seen.keyframe,
                "offset": keyframe.offset, "stands": keyframe.offset < asked.end,
                "text": f"{seen.class_name}, {keyframe_name(history, keyframe.keyframe)}",
                "names": [seen.det_id],
            }  # fmt: skip


_SOURCES: Final[Mapping[str, Callable[[AskedPoint, str], Iterator[dict[str, Any]]]]] = {
    "place": _places,
    "object": _objects,
    "run": _runs,
    "keyframe": _keyframes,
    "detection": _detections,
}
"""The searchable things by kind, with their ``names`` and the ``offset`` of their first event. Of
large kinds only those whose name contains the wanted text."""


def search_answer(shown: LogMap, query: QueryParams) -> dict[str, Any]:
    """The things whose name matches ``q``, best first: those that a command would take it for
    (`projections.map.naming`), then equal names, names that begin or end with it, and names that
    contain it. Letter case does not matter. ``kind`` asks for one kind only."""
    asked = AskedPoint.of(shown, query)
    text = text_of(query, "q")[:_MOST_TEXT].strip()
    wanted = text.casefold()
    kind = query.get("kind")
    if kind is not None and kind not in _SOURCES:
        raise QuestionError(f"kind is {kind[:40]!r}; give one of {', '.join(_SOURCES)}")
    sources = _SOURCES.values() if kind is None else [_SOURCES[kind]]
    named = chain.from_iterable(source(asked, wanted) for source in sources) if wanted else ()
    things = asked.known.things(asked.end) if wanted else []
    meant = {(thing.kind, thing.id) for thing in matches(text, things)[1]}
    found: list[_Found] = []
    for number, each in enumerate(named):
        rank = min(_rank(name.casefold(), wanted) for name in each.pop("names"))
        rank = -1 if (each["kind"], each["id"]) in meant else rank
        if rank < _NOT:
            found.append((rank, number, each))
    found.sort(key=lambda item: item[:2])
    return {
        **asked.document(),
        "found": [each for _, _, each in found[:MOST_FOUND]],
        "more": max(0, len(found) - MOST_FOUND),
    }


def find_answer(shown: LogMap, query: QueryParams) -> dict[str, Any]:
    """What ``mapfold find WHAT --json`` answers."""
    asked = AskedPoint.of(shown, query)
    what, place, near = (query.get(name) or None for name in ("what", "in", "near"))
    top, every = number_of(query, "top", Wanted.top), number_of(query, "all", 0) > 0
    if top == 0:
        raise QuestionError("top is 0; give how many answers there may be")
    wanted = Wanted(what=what, room=place, near=near, top=top, every=every)
    view = asked.known.at(asked.end)
    words = [] if what is None else [what]
    words += [w for name in ("in", "near") if query.get(name) for w in (f"--{name}", query[name])]
    words += ["--top", str(top), *(["--all"] if every else [])]
    return {
        **asked.document(),
        **find(view, wanted, words_of(view)).document(),
        "command": asked.command("find", *words),
    }


def path_answer(shown: LogMap, query: QueryParams) -> dict[str, Any]:
    """The way ``from`` one thing ``to`` another, and where that is an Object its goal, also as YAML
    for ROS 2; without ``from`` only the goal. What ``mapfold path A B`` answers."""
    asked = AskedPoint.of(shown, query)
    view = asked.known.at(asked.end)
    start, end = query.get("from") or None, text_of(query, "to")
    way = None if start is None else path(view, start, end)
    goal = goal_of(view, end) if way is None else way.goal
    words = ("find", end, "--goal", "yaml") if start is None else ("path", start, end)
    return {
        **asked.document(),
        "path": None if way is None else way.document(),
        "goal": None if goal is None else goal.document(),
        "yaml": None if goal is None else goal.pose_stamped(),
        "command": asked.command(*words),
    }


def keyframe_answer(shown: LogMap, query: QueryParams) -> dict[str, Any]:
    """A keyframe with its detections; `keyframe_of` reads which."""
    asked = AskedPoint.of(shown, query)
    history = asked.known.history
    ordinal = keyframe_of(history, query)
    view = asked.known.latest
    record = view.keyframes[ordinal]
    pose = record.pose
    place = history.place_at(ordinal, asked.end)
    objects = _objects_of(history, record.observations, asked.end)
    return {
        **asked.document(),
        "number": ordinal,
        "run_id": record.run_id,
        "keyframe_id": record.keyframe_id,
        "name": keyframe_name(history, ordinal),
        "offset": record.offset,
        "stamp": record.timestamp,
        "pose": None if pose is None else [pose.x_m, pose.y_m, pose.yaw_rad],
        "place": place,
        "detections": [
            _detection(history, view.observations[number], objects.get(number))
            for number in record.observations
        ],
    }


def _objects_of(
    history: History, observations: Collection[ObservationOrdinal], end: Offset
) -> dict[int, ObjectOrdinal]:
    """For each observation the object that it is part of after ``end`` events."""
    return {
        seen.observation: history.object_survivor(each.found.object, end)
        for each in history.objects
        for seen in each.sightings
        if seen.observation in observations and seen.offset < end
    }


def _detection(
    history: History, seen: ObservationRecord, found: ObjectOrdinal | None
) -> dict[str, Any]:
    return {
        "det_id": seen.det_id,
        "class_name": seen.class_name,
        "confidence": seen.confidence,
        "bbox": list(seen.bbox),
        "embedding": seen.embedding_crc is not None,
        "object": found,
        "object_id": None if found is None else history.objects[found].object_id,
    }


def keyframe_of(history: History, query: QueryParams) -> KeyframeOrdinal:
    """The keyframe of ``number``, its row of ``kf_``, or of ``keyframe``, ``RUN/ID``. Raises
    NoSuchThing."""
    number = query.get("number")
    if number is None:
        text = text_of(query, "keyframe")
        run, slash, id_ = text.rpartition("/")
        return find_keyframe(history, f"{run}:{id_}" if slash else text)
    if not (number.isascii() and number.isdecimal() and len(number) < 18):
        raise QuestionError(f"number is {number[:40]!r}; give the row of a keyframe")
    if int(number) >= len(history.keyframes):
        raise NoSuchThing("keyframe number", number, map(str, range(len(history.keyframes))))
    return KeyframeOrdinal(int(number))
