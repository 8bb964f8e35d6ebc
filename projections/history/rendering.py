"""Text output of `mapfold merges`, `bisect` and `why`."""

from collections.abc import Sequence

from eventsrc.base.text import counted, table
from eventsrc.envelope.model import Offset
from projections.fold.deltas import PlaceOrdinal
from projections.store.history import History
from projections.store.history_records import EdgeChange, Merge, ObjectMerge, RefusedMerge

from .bisect import Search, Turn
from .explanation import Explanation
from .merge_reasons import evidence_text, merge_reason, refuser
from .names import keyframe_name, place_name, place_title


def shortened(lines: Sequence[str], most: int | None, hint: str) -> list[str]:
    """The first ``most`` lines, and a line with the number of the others; all for None."""
    if most is None or len(lines) <= most:
        return list(lines)
    return [*lines[:most], f"… and {len(lines) - most:,} more ({hint})"]


_MERGES_HEADER = (
    "#",
    "offset",
    "time",
    "bridge",
    "survivor",
    "absorbed",
    "keyframes",
    "objects",
    "edges",
)
_REFUSALS_HEADER = ("offset", "time", "bridge", "places", "distance", "refused by")
_OBJECTS_HEADER = ("offset", "time", "keyframe", "survivor", "absorbed", "class")
MOST_THINGS = 12
"""Objects and edges of one merge that the text lists."""


def merges_text(history: History, merges: Sequence[Merge], end: Offset) -> str:
    """The table of merges, with the reasons of places by rooms; or that there are none."""
    if not merges:
        formed = sum(place.formed.offset < end for place in history.places)
        return f"no merges: {counted(end, 'event')} formed {counted(formed, 'place')}\n"
    rows = [merge_row(history, merge) for merge in merges]
    header: tuple[str, ...] = _MERGES_HEADER
    if history.settings.places == "rooms":
        header = (*header, "because")
        rows = [
            (*row, merge_reason(history, merge)) for row, merge in zip(rows, merges, strict=True)
        ]
    return table(header, rows, right=("#", "offset", "objects", "edges"))


def refusals_text(history: History, refusals: Sequence[RefusedMerge]) -> str:
    """The table of refused merges, or that there are none."""
    if not refusals:
        return "no merge was refused\n"
    rows = [
        (
            f"{refusal.cause.offset:,}",
            refusal.cause.when,
            keyframe_name(history, refusal.bridge),
            ", ".join(
                place_title(history, place, refusal.cause.offset)
                for place in (refusal.a, refusal.b)
            ),
            f"{refusal.link.distance_um / 1e6:.3f} m",
            refuser(history, refusal),
        )
        for refusal in refusals
    ]
    return table(_REFUSALS_HEADER, rows, right=("offset", "distance"))


def object_merges_text(history: History, merges: Sequence[ObjectMerge]) -> str:
    """The table of merges of objects, or that there are none."""
    if not merges:
        return "no merges of objects\n"
    by_evidence = any(merge.values.evidence is not None for merge in merges)
    rows = [
        (
            f"{merge.cause.offset:,}",
            merge.cause.when,
            merge.cause.name,
            history.objects[merge.survivor].object_id,
            history.objects[merge.absorbed].object_id,
            history.object_at(merge.survivor, Offset(merge.offset + 1)).class_name,
            *([evidence_text(merge.values.evidence)] if by_evidence else []),
        )
        for merge in merges
    ]
    header = (*_OBJECTS_HEADER, "because") if by_evidence else _OBJECTS_HEADER
    return table(header, rows, right=("offset",))


def merge_text(history: History, merge: Merge) -> str:
    """One merge: its reason, its places, and the objects and edges it moved."""
    cause, after = merge.cause, merge.cause.offset + 1
    lines = [
        f"merge {merge.number} at offset {cause.offset:,} ({cause.when}), shows from --at {after}",
        f"because   {merge_reason(history, merge, most_seen=None)}",
        f"survivor  {_place(history, merge, merge.survivor, merge.survivor_size)}",
    ]
    for place, size in zip(merge.absorbed, merge.absorbed_sizes, strict=True):
        lines.append(f"absorbed  {_place(history, merge, place, size)}")
    objects = [history.object_at(number, Offset(after)) for number in merge.objects]
    named = [f"object    {o.object_id} ({o.class_name})" for o in objects]
    lines += shortened(named, MOST_THINGS, "--json lists all")
    lines += shortened(
        [_edge_text(history, e) for e in merge.edges], MOST_THINGS, "--json lists all"
    )
    return "".join(f"{line}\n" for line in lines)


def merge_row(history: History, merge: Merge) -> tuple[str, ...]:
    """One row of the table of `merges_text`; names are those before the merge."""
    before = merge.cause.offset
    return (
        str(merge.number),
        f"{merge.cause.offset:,}",
        merge.cause.when,
        keyframe_name(history, merge.bridge),
        place_title(history, merge.survivor, before),
        ", ".join(
            place_title(history, place, before) + (" (joined)" if place in merge.joined else "")
            for place in merge.absorbed
        ),
        " + ".join(str(size) for size in (merge.survivor_size, *merge.absorbed_sizes)),
        str(len(merge.objects)),
        str(len(merge.edges)),
    )


def _place(history: History, merge: Merge, place: PlaceOrdinal, size: int) -> str:
    joined = ", joined by a command" if place in merge.joined else ""
    title = place_title(history, place, merge.cause.offset)
    return f"{title}, {counted(size, 'keyframe')}{joined}"


def _edge_text(history: History, edge: EdgeChange) -> str:
    a, b = place_name(history, edge.a), place_name(history, edge.b)
    return f"edge      {a} – {b}: {edge.before:,} → {counted(edge.after, 'shared transition')}"


def search_text(search: Search, *, most: int | None) -> str:
    """The event that made the condition true, the values before and after it, and other turns."""
    lines = [_verdict(search)]
    if search.found is not None:
        lines += _values(search.found)
    else:
        lines += [f"  {name}: {_value(value)} at the end" for name, value in search.at_end]
    others = [turn for turn in search.turns if turn is not search.found]
    lines += shortened([_turn_text(turn) for turn in others], most, "--json lists all")
    return "".join(f"{line}\n" for line in lines)


def _verdict(search: Search) -> str:
    if search.found is not None:
        cause = search.found.cause
        return (
            f"became true at offset {cause.offset:,} ({cause.title}), "
            f"shows from --at {cause.offset + 1}"
        )
    span = f"from --at {search.start} to {search.end}"
    if search.holds[0] and search.holds[1] and not search.turns:
        return f"true all along {span}"
    if search.holds[0]:
        return f"true at --at {search.start}, then false; it does not become true again {span}"
    return f"never true {span}"


def _values(turn: Turn) -> list[str]:
    after = dict(turn.after)
    return [
        f"  {name}: {_value(value)} → {_value(after[name])}"
        if value != after[name]
        else f"  {name}: {_value(value)}, before and after"
        for name, value in turn.before
    ]


def _turn_text(turn: Turn) -> str:
    word = "true" if turn.becomes else "false"
    cause = turn.cause
    return f"  turned {word} at offset {cause.offset:,} ({cause.title})"


def _value(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return "none" if value is None else str(value)


def explanation_text(found: Explanation) -> str:
    """The summary, then one entry a line: offset, time, what happened."""
    subject = found.subject if found.kind == "same" else f"{found.kind} {found.subject}"
    lines = [f"{subject}: {found.summary}"]
    width = max((len(f"{e.cause.offset:,}") for e in found.entries), default=1)
    for entry in found.entries:
        time = entry.cause.when
        lines.append(f"  {entry.cause.offset:>{width},}  {time}  {entry.text}")
    return "".join(f"{line}\n" for line in lines)
