"""Why two keyframes are in one place, and since which event.

Each keyframe joined one place when it was placed; a chain of absorptions leads from there to its
place at any later event. The two are in one place from the event after which both chains lead to
the same place, and the merges on the two chains up to that event are the reason.
"""

from eventsrc.base.text import counted
from eventsrc.envelope.model import Offset
from projections.fold.deltas import KeyframeOrdinal
from projections.store.history import History
from projections.store.history_rows import NEVER
from projections.store.records import Merge

from .explanation import Entry, Explanation, position_text
from .merges import merge_reason
from .names import id_of_place, keyframe_name, place_name, place_title


def explain_same_place(
    history: History, first: KeyframeOrdinal, second: KeyframeOrdinal, end: Offset
) -> Explanation:
    """Why keyframes ``first`` and ``second`` are in one place, or not, after ``end`` events."""
    since = together_since(history, first, second)
    together = since is not None and since < end
    until = Offset(since + 1) if since is not None and together else end
    entries = [
        _placed_entry(history, k)
        for k in dict.fromkeys((first, second))
        if history.placed_offsets[k] < end
    ]
    entries += [
        _merged_entry(history, merge) for merge in _merges_of(history, (first, second), until)
    ]
    return Explanation(
        kind="same",
        subject=f"{keyframe_name(history, first)} and {keyframe_name(history, second)}",
        summary=_same_place_summary(history, first, second, since if together else None, end),
        entries=tuple(sorted(entries, key=lambda entry: entry.cause.offset)),
        facts={
            "same": together,
            "since": since if together else None,
            "places": [id_of_place(history, history.place_at(k, end)) for k in (first, second)],
        },
    )


def together_since(
    history: History, first: KeyframeOrdinal, second: KeyframeOrdinal
) -> Offset | None:
    """The offset of the event that first brought two keyframes into one place; None for never."""
    joined = Offset(max(history.placed_offsets[first], history.placed_offsets[second]))
    if joined == NEVER:
        return None
    chain = _merges_of(history, (first, second), NEVER)
    for offset in sorted({joined, *(m.cause.offset for m in chain if m.cause.offset > joined)}):
        after = Offset(offset + 1)
        if history.place_at(first, after) == history.place_at(second, after):
            return offset
    return None


def _merges_of(
    history: History, keyframes: tuple[KeyframeOrdinal, KeyframeOrdinal], end: Offset
) -> list[Merge]:
    """Merges below ``end`` that moved either keyframe from one place to another, in order."""
    merges: dict[int, Merge] = {}
    for keyframe in keyframes:
        if history.placed_offsets[keyframe] >= end:
            continue
        place = history.placed_in[keyframe]
        while (merge := history.places[place].absorbed_by) is not None and merge.cause.offset < end:
            merges[merge.number] = merge
            place = merge.survivor
    return [merges[number] for number in sorted(merges)]


def _placed_entry(history: History, keyframe: KeyframeOrdinal) -> Entry:
    place = place_name(history, history.placed_in[keyframe])
    offset = Offset(history.placed_offsets[keyframe])
    own = history.keyframe_offsets[keyframe]
    wait = counted(offset - own, "event")
    late = "" if offset == own else f", {wait} after it came: it was noise before"
    name = keyframe_name(history, keyframe)
    return Entry(
        history.cause_at(offset),
        "placed",
        f"{name} at {position_text(history.keyframes[keyframe].pose)} joined {place}{late}",
        {"keyframe": name, "place_id": place},
    )


def _merged_entry(history: History, merge: Merge) -> Entry:
    survivor = place_name(history, merge.survivor)
    absorbed = ", ".join(place_name(history, place) for place in merge.absorbed)
    return Entry(
        merge.cause,
        "merged",
        f"{survivor} absorbed {absorbed}; {merge_reason(history, merge)}",
        {"merge": merge.number},
    )


def _same_place_summary(
    history: History,
    first: KeyframeOrdinal,
    second: KeyframeOrdinal,
    since: Offset | None,
    end: Offset,
) -> str:
    if since is not None:
        cause = history.cause_at(since)
        now = place_title(history, history.place_at(first, end), end)
        return f"in one place since offset {since:,} ({cause.title}); it is {now} now"
    return "not in one place: " + "; ".join(
        _place_of_keyframe(history, k, end) for k in (first, second)
    )


def _place_of_keyframe(history: History, keyframe: KeyframeOrdinal, end: Offset) -> str:
    name = keyframe_name(history, keyframe)
    if history.keyframe_offsets[keyframe] >= end:
        return f"{name} has not come yet"
    if history.keyframes[keyframe].pose is None:
        return f"{name} has no pose"
    place = history.place_at(keyframe, end)
    where = "noise" if place is None else f"in {place_title(history, place, end)}"
    return f"{name} is {where}"
