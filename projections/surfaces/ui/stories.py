"""Why a place, an object or a keyframe is what it is, why places merged, and one merge in full.

``lines`` are what the command prints; ``steps`` are the same events with their offsets and the
places, objects and keyframes they name, for links. A merge in full has the chain of core points
that linked its places, and the places before it.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Any, Final

from starlette.datastructures import QueryParams

from eventsrc.base.text import shortening, visible
from eventsrc.envelope.model import Offset
from projections.fold.deltas import KeyframeOrdinal
from projections.fold.map_errors import QuestionError
from projections.history import NoSuchThing
from projections.history.explanation import Entry, Explanation, explain_same_place
from projections.history.merge_reasons import (
    chains_of,
    merge_document,
    merge_reason,
    object_merge_document,
    refusal_document,
)
from projections.history.names import find_keyframe, keyframe_name, place_name
from projections.history.rendering import (
    explanation_text,
    merge_text,
    object_merges_text,
    refusals_text,
)
from projections.map.naming import ShortIds
from projections.store.history import History
from projections.store.history_records import Merge, ObjectMerge, RefusedMerge

from .log_map import LogMap
from .requests import AskedPoint, lines_of, text_of

_MOST_CORE: Final = 2000


def merge_answer(asked: AskedPoint, name: str) -> dict[str, Any]:
    """The merges of the event at an offset: of places, refused, and of objects."""
    if not (name.isascii() and name.isdecimal() and len(name) <= 18):
        raise QuestionError(f"merge:{name[:40]} names no offset; write merge:348")
    offset, known = int(name), asked.known
    history = known.history
    merges = [m for m in known.merges(asked.end) if m.cause.offset == offset]
    refusals = [r for r in known.refusals(asked.end) if r.cause.offset == offset]
    objects = [m for m in known.object_merges(asked.end) if m.offset == offset]
    if not merges and not refusals and not objects:
        every = {m.cause.offset for m in known.merges(asked.end)}
        every |= {r.cause.offset for r in known.refusals(asked.end)}
        every |= {m.offset for m in known.object_merges(asked.end)}
        raise NoSuchThing("merge at offset", name, map(str, sorted(every)))
    short = asked.short_ids
    with shortening(short.text):  # tables are as wide as the ids
        texts = [merge_text(history, merge) for merge in merges]
        texts += [refusals_text(history, refusals)] if refusals else []
        texts += [object_merges_text(history, objects)] if objects else []
    summary = _summary(history, merges) or _other_summary(history, refusals, objects)
    return {
        **asked.document(),
        "kind": "merge",
        "subject": name,
        "summary": visible(short.text(summary)),
        "lines": [line for text in texts for line in lines_of(text, short)],
        "steps": [
            {
                "offset": offset,
                "time": merge.cause.time,
                "what": "merged",
                "text": visible(
                    short.text(f"{_summary(history, [merge])}; {merge_reason(history, merge)}")
                ),
                "refs": _with_short(_merge_refs(history, merge), short),
            }
            for merge in merges
        ],
        "merges": [_bridge(history, merge) for merge in merges],
        "refused": [refusal_document(history, refusal) for refusal in refusals],
        "objects": [object_merge_document(history, merge) for merge in objects],
        "command": _command(asked, merges, refused=bool(refusals)),
    }


def _command(asked: AskedPoint, merges: list[Merge], *, refused: bool) -> str:
    if merges:
        return asked.command("merges", "--show", merges[0].number)
    return asked.command("merges", "--refused" if refused else "--objects")


def _summary(history: History, merges: list[Merge]) -> str:
    return "; ".join(
        f"{place_name(history, merge.survivor)} absorbed "
        + ", ".join(place_name(history, place) for place in merge.absorbed)
        for merge in merges
    )


def _other_summary(
    history: History, refusals: list[RefusedMerge], objects: list[ObjectMerge]
) -> str:
    """The summary of an event that merged no places."""
    refused = [
        f"{place_name(history, each.a)} and {place_name(history, each.b)} did not merge: refused"
        for each in refusals
    ]
    ids = [[history.objects[n].object_id for n in (m.survivor, m.absorbed)] for m in objects]
    return "; ".join(refused or [f"{survivor} absorbed {absorbed}" for survivor, absorbed in ids])


def _merge_refs(history: History, merge: Merge) -> list[dict[str, str]]:
    bridge = history.keyframes[merge.bridge]
    objects = [history.objects[number].object_id for number in merge.objects]
    return [
        {"kind": "keyframe", "id": f"{bridge.run_id}/{bridge.keyframe_id}"},
        *({"kind": "place", "id": place_name(history, place)} for place in merge.places),
        *({"kind": "object", "id": name} for name in objects),
    ]


def _bridge(history: History, merge: Merge) -> dict[str, Any]:
    """The merge with what is needed to draw it. Keyframes are rows of ``kf_``.

    ``core`` are the core points of the two sides near the chain, old ones and those that the event
    made (``made_core``); none under rules that know no core points.
    """
    offset = merge.cause.offset
    chains = chains_of(history, merge)
    points = [point for chain in chains for point in chain.points]
    points += [end for link in merge.links for end in (link.core, link.neighbour)]
    by_core_points = history.settings.places == "page"
    core = _core_points(history, points, Offset(offset + 1)) if by_core_points else []
    sizes = [merge.survivor_size, *merge.absorbed_sizes]
    return {
        **merge_document(history, merge),
        "offset": offset,
        "eps_m": history.settings.eps_m if by_core_points else None,
        "min_samples": history.settings.min_samples if by_core_points else None,
        "bridge": merge.bridge,
        "chain_points": [list(chain.points) for chain in chains],
        "link_points": [[link.core, link.neighbour] for link in merge.links],
        "core": core,
        "made_core": history.neighbours.made_core(merge.bridge, offset) if by_core_points else [],
        "positions": [_position(history, point) for point in dict.fromkeys([*points, *core])],
        "sides": [
            {"place": place, "place_id": place_name(history, place), "keyframes": size}
            for place, size in zip(merge.places, sizes, strict=True)
        ],
    }


def _core_points(
    history: History, points: list[KeyframeOrdinal], end: Offset
) -> list[KeyframeOrdinal]:
    """The core points within ε of the points, themselves included, after ``end`` events."""
    near: dict[KeyframeOrdinal, None] = {}
    for point in dict.fromkeys(points):
        if history.keyframes[point].pose is not None:
            near |= dict.fromkeys(history.neighbours.of(point, end))
        if len(near) > _MOST_CORE:
            break
    return sorted(k for k in list(near)[:_MOST_CORE] if history.neighbours.is_core(k, end))


def _position(history: History, point: KeyframeOrdinal) -> dict[str, Any]:
    pose = history.keyframes[point].pose
    return {
        "keyframe": point,
        "name": keyframe_name(history, point),
        "x": None if pose is None else pose.x_m,
        "y": None if pose is None else pose.y_m,
    }


_KINDS: Final = "place:ID, object:ID, keyframe:RUN/ID or merge:OFFSET"
_MOST_REFS: Final = 50


def why_answer(shown: LogMap, query: QueryParams) -> dict[str, Any]:
    """The explanation of the thing named by ``what``; with ``other``, a keyframe, since when both
    keyframes are in one place."""
    asked = AskedPoint.of(shown, query)
    what = text_of(query, "what")
    kind, _, name = what.partition(":")
    if kind == "merge":
        return merge_answer(asked, name)
    if not name or kind not in ("place", "object", "keyframe"):
        raise QuestionError(f"what is {what[:80]!r}; write {_KINDS}")
    return _keyframe_story(asked, name) if kind == "keyframe" else _story_of(asked, name)


def _story_of(asked: AskedPoint, name: str) -> dict[str, Any]:
    found = asked.known.why(name, asked.end)
    return _document(asked, found, asked.command("why", name))


def _keyframe_story(asked: AskedPoint, name: str) -> dict[str, Any]:
    history = asked.known.history
    names = [_keyframe_name(name)]
    if other := asked.query.get("other"):
        names.append(_keyframe_name(other.removeprefix("keyframe:")))
        found = asked.known.why_same(names[0], names[1], asked.end)
        return _document(asked, found, asked.command("why", "--same", *names))
    keyframe = find_keyframe(history, names[0])
    found = explain_same_place(history, keyframe, keyframe, asked.end)
    place = history.place_at(keyframe, asked.end)
    came = history.keyframes[keyframe]
    where = "it has no pose" if came.pose is None else "it is in no place: noise"
    if place is not None:
        where = f"in {history.places[place].place_id}"
    if came.offset >= asked.end:
        where = f"not there yet: it comes at offset {came.offset}"
    command = asked.command("why", "--same", names[0], names[0])
    return _document(asked, found, command) | {
        "kind": "keyframe",
        "subject": names[0],
        "summary": visible(asked.short_ids.text(where)),
        "lines": lines_of(
            "\n".join([f"{names[0]}: {where}", *map(_line, found.entries)]), asked.short_ids
        ),
    }


def _keyframe_name(name: str) -> str:
    """``RUN/ID`` as the commands write it; a run may have slashes itself."""
    run, slash, number = name.rpartition("/")
    return f"{run}:{number}" if slash else name


def _line(entry: Entry) -> str:
    return f"  {entry.cause.offset}  {entry.cause.when}  {entry.text}"


def _document(asked: AskedPoint, found: Explanation, command: str) -> dict[str, Any]:
    short = asked.short_ids
    return {
        **asked.document(),
        "kind": found.kind,
        "subject": found.subject,
        "summary": visible(short.text(found.summary)),
        "facts": found.facts,
        "lines": lines_of(explanation_text(found), short),
        "steps": [_step(asked.known.history, entry, short) for entry in found.entries],
        "command": command,
    }


def _step(history: History, entry: Entry, short: ShortIds) -> dict[str, Any]:
    return {
        "offset": entry.cause.offset,
        "time": entry.cause.time,
        "what": entry.what,
        "text": visible(short.text(entry.text)),
        "refs": _with_short(list(_refs(history, entry))[:_MOST_REFS], short),
    }


def _with_short(refs: list[dict[str, str]], short: ShortIds) -> list[dict[str, str]]:
    """Things to link, with the ``name`` by which the text has one where that is not its id."""
    names = [short(ref["id"]) for ref in refs]
    return [
        ref if name == ref["id"] else ref | {"name": name}
        for ref, name in zip(refs, names, strict=True)
    ]


def _refs(history: History, entry: Entry) -> Iterable[dict[str, str]]:
    """The things that a step names: the keyframe that caused it, then those in its facts; each
    once."""
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
