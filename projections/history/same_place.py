"""Since when two keyframes are in one place, and through which chain of merges.

Each keyframe joined one place when it was placed; from there absorptions lead on. The two became
one at the event after which both chains lead to the same place, and the merges on the two chains up
to that event are why.

From what a person typed to the thing that is meant; what is not there is answered with what is.

Place and object ids and keyframes are looked up in the whole history, so an absorbed place is found
too. A name that is nowhere raises `NoSuchThing`, which lists the nearest names.
"""

import difflib
import re
from collections.abc import Iterable

from eventsrc.envelope import Offset
from eventsrc.errors import MisuseError
from eventsrc.text import counted
from projections.deltas import KeyframeOrdinal

from .bisect import keyframe_number
from .history import NEVER, History
from .merges import reason
from .records import Merge, ObjectLife, PlaceLife
from .story import Entry, Story, keyframe_name, place_name, spot


def same_story(
    history: History, first: KeyframeOrdinal, second: KeyframeOrdinal, end: Offset
) -> Story:
    """Why keyframes ``first`` and ``second`` are, or are not, in one place at ``end``."""
    since = together_since(history, first, second)
    together = since is not None and since < end
    until = Offset(since + 1) if since is not None and together else end
    entries = [_placing(history, k) for k in (first, second) if history.placed_offsets[k] < end]
    entries += [_merging(history, merge) for merge in _chain(history, (first, second), until)]
    return Story(
        kind="same",
        subject=f"{keyframe_name(history, first)} and {keyframe_name(history, second)}",
        summary=_summary(history, first, second, since if together else None, end),
        entries=tuple(sorted(entries, key=lambda entry: entry.cause.offset)),
        facts={
            "same": together,
            "since": since if together else None,
            "places": [_place_id(history, k, end) for k in (first, second)],
        },
    )


def together_since(
    history: History, first: KeyframeOrdinal, second: KeyframeOrdinal
) -> Offset | None:
    """The offset of the event that first brought two keyframes into one place, ever."""
    joined = Offset(max(history.placed_offsets[first], history.placed_offsets[second]))
    if joined == NEVER:
        return None
    chain = _chain(history, (first, second), NEVER)
    for offset in sorted({joined, *(m.cause.offset for m in chain if m.cause.offset > joined)}):
        after = Offset(offset + 1)
        if history.place_at(first, after) == history.place_at(second, after):
            return offset
    return None


def _chain(
    history: History, keyframes: tuple[KeyframeOrdinal, KeyframeOrdinal], end: Offset
) -> list[Merge]:
    """Merges below ``end`` that carried either keyframe from one place to another, in order."""
    merges: dict[int, Merge] = {}
    for keyframe in keyframes:
        if history.placed_offsets[keyframe] >= end:
            continue
        place = history.placed_in[keyframe]
        while (merge := history.places[place].absorbed) is not None and merge.cause.offset < end:
            merges[merge.number] = merge
            place = merge.survivor
    return [merges[number] for number in sorted(merges)]


def _placing(history: History, keyframe: KeyframeOrdinal) -> Entry:
    place = place_name(history, history.placed_in[keyframe])
    offset = Offset(history.placed_offsets[keyframe])
    own = history.keyframe_offsets[keyframe]
    wait = counted(offset - own, "event")
    late = "" if offset == own else f", {wait} after it came: it was noise before"
    name = keyframe_name(history, keyframe)
    return Entry(
        history.cause_at(offset),
        "placed",
        f"{name} at {spot(history.keyframes[keyframe].pose)} joined {place}{late}",
        {"keyframe": name, "place_id": place},
    )


def _merging(history: History, merge: Merge) -> Entry:
    absorbed = ", ".join(place_name(history, place) for place in merge.absorbed)
    return Entry(
        merge.cause,
        "merged",
        f"{place_name(history, merge.survivor)} absorbed {absorbed}; {reason(history, merge)}",
        {"merge": merge.number},
    )


def _summary(
    history: History,
    first: KeyframeOrdinal,
    second: KeyframeOrdinal,
    since: Offset | None,
    end: Offset,
) -> str:
    if since is not None:
        cause = history.cause_at(since)
        now = place_name(history, history.place_at(first, end))
        return f"in one place since offset {since:,} ({cause.title}); it is {now} now"
    return "not in one place: " + "; ".join(_where(history, k, end) for k in (first, second))


def _where(history: History, keyframe: KeyframeOrdinal, end: Offset) -> str:
    name = keyframe_name(history, keyframe)
    if history.keyframe_offsets[keyframe] >= end:
        return f"{name} has not come yet"
    if history.keyframes[keyframe].pose is None:
        return f"{name} has no pose"
    place = history.place_at(keyframe, end)
    return f"{name} is noise" if place is None else f"{name} is in {place_name(history, place)}"


def _place_id(history: History, keyframe: KeyframeOrdinal, end: Offset) -> str | None:
    place = history.place_at(keyframe, end)
    return None if place is None else place_name(history, place)


MOST_NAMES = 5


class NoSuchThing(MisuseError):
    """Nothing of this name is in the history; the message lists the nearest names.

    Places and objects depend on the settings, the rest on the log alone.
    """

    def __init__(self, kind: str, text: str, names: Iterable[str]) -> None:
        where = "under these settings" if kind in ("place", "object") else "in this log"
        super().__init__(f"no {kind} {text!r} {where}; {_nearest(kind, text, list(names))}")


def find_place(history: History, text: str) -> PlaceLife:
    """The place of this id, standing or absorbed."""
    number = history.place_numbers.get(text)
    if number is None:
        raise NoSuchThing("place", text, history.place_numbers)
    return history.places[number]


def find_object(history: History, text: str) -> ObjectLife:
    """The object of this id."""
    number = history.object_numbers.get(text)
    if number is None:
        raise NoSuchThing("object", text, history.object_numbers)
    return history.objects[number]


def find_keyframe(history: History, text: str) -> KeyframeOrdinal:
    """The ordinal of the keyframe written ``run_id:keyframe_id``."""
    number = keyframe_number(history, text)
    if number is None:
        names = (f"{k.run_id}:{k.keyframe_id}" for k in history.keyframes)
        raise NoSuchThing("keyframe", text, names)
    return number


def _nearest(kind: str, text: str, names: list[str]) -> str:
    if not names:
        return f"there is no {kind} at all"
    near = _near_numbers(text, names) or difflib.get_close_matches(text, names, MOST_NAMES, 0.6)
    if near:
        return f"near it: {', '.join(near)}"
    more = f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else ""
    return f"there are {', '.join(names[:MOST_NAMES])}{more}"


def _near_numbers(text: str, names: list[str]) -> list[str]:
    """Names equal but for their last number, the nearest numbers first: house-a:913 → :912."""
    stem, number = _split(text)
    if number is None:
        return []
    same = [
        (abs(n - number), name)
        for name in names
        for s, n in [_split(name)]
        if s == stem and n is not None
    ]
    return [name for _, name in sorted(same)[:MOST_NAMES]]


def _split(text: str) -> tuple[str, int | None]:
    match = re.fullmatch(r"(.*?)(\d{1,18})", text, re.DOTALL)
    return (match[1], int(match[2])) if match else (text, None)
