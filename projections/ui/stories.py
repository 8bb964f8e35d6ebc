"""Why a place, an object or a keyframe is what it is, and why places merged: step by step.

``lines`` are what the command prints; ``steps`` the same events with their offsets and with what
they name, so that a page can lead there.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Any, Final

from starlette.datastructures import QueryParams

from eventsrc.text import visible, visible_lines
from projections.errors import QuestionError
from projections.history.explanation import Entry, Explanation
from projections.history.history import History
from projections.history.names import find_keyframe
from projections.history.rendering import explanation_text
from projections.history.same_place import explain_same_place

from .log_map import LogMap
from .merge_story import merge_answer
from .moment import Moment
from .requests import text_of

_KINDS: Final = "place:ID, object:ID, keyframe:RUN/ID or merge:OFFSET"
_MOST_REFS: Final = 50


def why_answer(shown: LogMap, query: QueryParams) -> dict[str, Any]:
    """The story of what ``what`` names; with ``other``, a keyframe, since when both are in one
    place."""
    moment = Moment.of(shown, query)
    what = text_of(query, "what")
    kind, _, name = what.partition(":")
    if kind == "merge":
        return merge_answer(moment, name)
    if not name or kind not in ("place", "object", "keyframe"):
        raise QuestionError(f"what is {what[:80]!r}; write {_KINDS}")
    return _keyframe_story(moment, name) if kind == "keyframe" else _story_of(moment, name)


def _story_of(moment: Moment, name: str) -> dict[str, Any]:
    found = moment.known.why(name, moment.end)
    return _document(moment, found, moment.command("why", name))


def _keyframe_story(moment: Moment, name: str) -> dict[str, Any]:
    history = moment.known.history
    names = [_keyframe_name(name)]
    if other := moment.query.get("other"):
        names.append(_keyframe_name(other.removeprefix("keyframe:")))
        found = moment.known.why_same(names[0], names[1], moment.end)
        return _document(moment, found, moment.command("why", "--same", *names))
    keyframe = find_keyframe(history, names[0])
    found = explain_same_place(history, keyframe, keyframe, moment.end)
    place = history.place_at(keyframe, moment.end)
    came = history.keyframes[keyframe]
    where = "it has no pose" if came.pose is None else "it is in no place: noise"
    if place is not None:
        where = f"in {history.places[place].place_id}"
    if came.offset >= moment.end:
        where = f"not there yet: it comes at offset {came.offset}"
    told = moment.command("why", "--same", names[0], names[0])
    return _document(moment, found, told) | {
        "kind": "keyframe",
        "subject": names[0],
        "summary": visible(where),
        "lines": [visible(f"{names[0]}: {where}"), *map(_line, found.entries)],
    }


def _keyframe_name(name: str) -> str:
    """``RUN/ID`` as the commands write it; a run may have slashes itself."""
    run, slash, number = name.rpartition("/")
    return f"{run}:{number}" if slash else name


def _line(entry: Entry) -> str:
    return visible(f"  {entry.cause.offset}  {entry.cause.when}  {entry.text}")


def _document(moment: Moment, found: Explanation, command: str) -> dict[str, Any]:
    return {
        **moment.document(),
        "kind": found.kind,
        "subject": found.subject,
        "summary": visible(found.summary),
        "facts": found.facts,
        "lines": visible_lines(explanation_text(found)).splitlines(),
        "steps": [_step(moment.known.history, entry) for entry in found.entries],
        "command": command,
    }


def _step(history: History, entry: Entry) -> dict[str, Any]:
    return {
        "offset": entry.cause.offset,
        "time": entry.cause.time,
        "what": entry.what,
        "text": visible(entry.text),
        "refs": list(_refs(history, entry))[:_MOST_REFS],
    }


def _refs(history: History, entry: Entry) -> Iterable[dict[str, str]]:
    """What a step names: the keyframe that caused it, then what its facts name; each once."""
    found: dict[tuple[str, str], None] = {}  # in order
    if entry.cause.run_id is not None:
        found["keyframe", f"{entry.cause.run_id}/{entry.cause.keyframe_id}"] = None
    for name, value in entry.facts.items():
        ref = _REF.get(_FACTS.get(name, ""))
        values = value if isinstance(value, list) else [value]
        for each in values:
            if ref is not None and each is not None:
                found[ref(history, each)] = None
    return ({"kind": kind, "id": id_} for kind, id_ in found)


_FACTS: Final[Mapping[str, str]] = {
    "founder": "keyframe",
    "members": "keyframe",
    "keyframe": "keyframe",
    "place_id": "place",
    "places": "place",
    "survivor": "place",
    "from": "place",
    "to": "place",
    "object_id": "object",
    "merge": "merge",
}


def _merge_ref(history: History, number: Any) -> tuple[str, str]:
    return "merge", str(history.merges[number - 1].cause.offset)


def _keyframe_ref(_: History, name: Any) -> tuple[str, str]:
    return "keyframe", "/".join(str(name).rsplit(":", 1))


def _place_ref(_: History, name: Any) -> tuple[str, str]:
    return "place", str(name)


def _object_ref(_: History, name: Any) -> tuple[str, str]:
    return "object", str(name)


_REF: Final[Mapping[str, Callable[[History, Any], tuple[str, str]]]] = {
    "keyframe": _keyframe_ref,
    "place": _place_ref,
    "object": _object_ref,
    "merge": _merge_ref,
}
