"""A merge of places in full: the chain of core points that linked them, and what each side was."""

from typing import Any, Final

from eventsrc.envelope import Offset
from eventsrc.text import visible, visible_lines
from projections.deltas import KeyframeOrdinal
from projections.errors import QuestionError
from projections.history import NoSuchThing
from projections.history.history import History
from projections.history.merges import (
    chains_of,
    merge_document,
    merge_reason,
    object_merge_document,
    refusal_document,
)
from projections.history.names import keyframe_name, place_name
from projections.history.records import Merge, ObjectMerge, Refusal
from projections.history.rendering import merge_text, object_merges_text, refusals_text

from .moment import Moment

_MOST_CORE: Final = 2000


def merge_answer(moment: Moment, name: str) -> dict[str, Any]:
    """The merges of the event at an offset: of places, refused, and of objects."""
    if not (name.isascii() and name.isdecimal() and len(name) <= 18):
        raise QuestionError(f"merge:{name[:40]} names no offset; write merge:348")
    offset, known = int(name), moment.known
    history = known.history
    merges = [m for m in known.merges(moment.end) if m.cause.offset == offset]
    refusals = [r for r in known.refusals(moment.end) if r.cause.offset == offset]
    objects = [m for m in known.object_merges(moment.end) if m.offset == offset]
    if not merges and not refusals and not objects:
        every = {m.cause.offset for m in known.merges(moment.end)}
        every |= {r.cause.offset for r in known.refusals(moment.end)}
        every |= {m.offset for m in known.object_merges(moment.end)}
        raise NoSuchThing("merge at offset", name, map(str, sorted(every)))
    texts = [merge_text(history, merge) for merge in merges]
    texts += [refusals_text(history, refusals)] if refusals else []
    texts += [object_merges_text(history, objects)] if objects else []
    return {
        **moment.document(),
        "kind": "merge",
        "subject": name,
        "summary": visible(_summary(history, merges) or _other_summary(history, refusals, objects)),
        "lines": [line for text in texts for line in visible_lines(text).splitlines()],
        "steps": [
            {
                "offset": offset,
                "time": merge.cause.time,
                "what": "merged",
                "text": visible(f"{_summary(history, [merge])}; {merge_reason(history, merge)}"),
                "refs": _refs(history, merge),
            }
            for merge in merges
        ],
        "merges": [_bridge(history, merge) for merge in merges],
        "refused": [refusal_document(history, refusal) for refusal in refusals],
        "objects": [object_merge_document(history, merge) for merge in objects],
        "command": _command(moment, merges, refused=bool(refusals)),
    }


def _command(moment: Moment, merges: list[Merge], *, refused: bool) -> str:
    if merges:
        return moment.command("merges", "--show", merges[0].number)
    return moment.command("merges", "--refused" if refused else "--objects")


def _summary(history: History, merges: list[Merge]) -> str:
    return "; ".join(
        f"{place_name(history, merge.survivor)} absorbed "
        + ", ".join(place_name(history, place) for place in merge.absorbed)
        for merge in merges
    )


def _other_summary(history: History, refusals: list[Refusal], objects: list[ObjectMerge]) -> str:
    """Of an event that merged no places."""
    refused = [
        f"{place_name(history, each.a)} and {place_name(history, each.b)} did not merge: refused"
        for each in refusals
    ]
    ids = [[history.objects[n].object_id for n in (m.survivor, m.absorbed)] for m in objects]
    return "; ".join(refused or [f"{survivor} absorbed {absorbed}" for survivor, absorbed in ids])


def _refs(history: History, merge: Merge) -> list[dict[str, str]]:
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
