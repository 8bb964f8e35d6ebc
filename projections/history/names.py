"""Names of keyframes, places and objects in a history, and look-up by name.

Names are looked up in the whole history, so an absorbed place is found too. A name that is not in
it raises `NoSuchThing`, which lists the nearest names.
"""

import difflib
import re
from collections.abc import Iterable

from eventsrc.base.errors import MisuseError
from eventsrc.envelope.model import KeyframeId, Offset, RunId
from projections.fold.corrections import Keyframe
from projections.fold.deltas import KeyframeOrdinal, PlaceOrdinal
from projections.store.history import History
from projections.store.history_records import ObjectHistory, PlaceHistory

MOST_NAMES = 5
"""Names that an error message lists."""


class NoSuchThing(MisuseError):
    """No thing of this name is in the history; the message lists the nearest names.

    Places and objects depend on the settings, keyframes, runs and classes on the log alone.
    """

    def __init__(self, kind: str, text: str, names: Iterable[str]) -> None:
        where = "under these settings" if kind in ("place", "object") else "in this log"
        super().__init__(f"no {kind} {text!r} {where}; {_nearest(kind, text, list(names))}")


def keyframe_name(history: History, keyframe: KeyframeOrdinal) -> str:
    """``run_id:keyframe_id``."""
    added = history.keyframes[keyframe]
    return f"{added.run_id}:{added.keyframe_id}"


def log_name(history: History, keyframe: KeyframeOrdinal) -> Keyframe:
    """Run and keyframe id: the form in which commands name a keyframe."""
    added = history.keyframes[keyframe]
    return Keyframe(added.run_id, added.keyframe_id)


def id_of_place(history: History, place: PlaceOrdinal | None) -> str | None:
    """The place's id; None for no place."""
    return None if place is None else history.places[place].place_id


def place_name(history: History, place: PlaceOrdinal | None) -> str:
    """The place's id, or ``no place``."""
    return id_of_place(history, place) or "no place"


def place_title(history: History, place: PlaceOrdinal | None, end: Offset) -> str:
    """``run_p3``, or ``run_p3 "kitchen"`` where it has a name after ``end`` events."""
    name = None if place is None else history.places[place].name(end)
    return place_name(history, place) + ("" if name is None else f' "{name}"')


def keyframe_ordinal(history: History, text: str) -> KeyframeOrdinal | None:
    """The ordinal of the keyframe ``run_id:keyframe_id``, None if there is none.

    A run id may hold colons.
    """
    run_id, _, number = text.rpartition(":")
    try:
        return history.keyframe_ordinals.get((RunId(run_id), KeyframeId(int(number))))
    except ValueError:
        return None


def find_keyframe(history: History, text: str) -> KeyframeOrdinal:
    """The ordinal of the keyframe ``run_id:keyframe_id``. Raises NoSuchThing."""
    ordinal = keyframe_ordinal(history, text)
    if ordinal is None:
        names = (f"{k.run_id}:{k.keyframe_id}" for k in history.keyframes)
        raise NoSuchThing("keyframe", text, names)
    return ordinal


def find_place(history: History, text: str, end: Offset) -> PlaceHistory:
    """The place of this id, standing or absorbed, or the one that is called so after ``end``
    events. Raises NoSuchThing, and MisuseError for a name that several places have."""
    ordinal = history.place_ordinals.get(text)
    if ordinal is not None:
        return history.places[ordinal]
    called = [p for p in history.places if p.names and p.stands(end) and p.name(end) == text]
    if len(called) > 1:
        ids = ", ".join(place.place_id for place in called)
        raise MisuseError(f"{text!r} is the name of several places; give one of {ids}")
    if not called:
        names = [n.name for p in history.places for n in p.names if n.name is not None]
        raise NoSuchThing("place", text, [*history.place_ordinals, *dict.fromkeys(names)])
    return called[0]


def find_object(history: History, text: str) -> ObjectHistory:
    """The object of this id. Raises NoSuchThing."""
    ordinal = history.object_ordinals.get(text)
    if ordinal is None:
        raise NoSuchThing("object", text, history.object_ordinals)
    return history.objects[ordinal]


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
    stem, number = _split_number(text)
    if number is None:
        return []
    same_stem = [
        (abs(n - number), name)
        for name in names
        for s, n in [_split_number(name)]
        if s == stem and n is not None
    ]
    return [name for _, name in sorted(same_stem)[:MOST_NAMES]]


def _split_number(text: str) -> tuple[str, int | None]:
    """``house-a:913`` → ``house-a:``, 913; None for a text that ends with no number."""
    match = re.fullmatch(r"(.*?)(\d{1,18})", text, re.DOTALL)
    return (match[1], int(match[2])) if match else (text, None)
