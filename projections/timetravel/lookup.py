"""From what a person typed to the thing that is meant; what is not there is answered with what is.

Place and object ids and keyframes are looked up in the whole history, so an absorbed place is found
too. A name that is nowhere raises `NoSuchThing`, which lists the nearest names.
"""

import difflib
import re
from collections.abc import Iterable

from eventsrc.errors import MisuseError

from .facts import keyframe_number
from .history import History
from .lives import ObjectLife, PlaceLife

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


def find_keyframe(history: History, text: str) -> int:
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
