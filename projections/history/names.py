"""Names of keyframes and places in a history, and what in it may be called by a name."""

from dataclasses import replace

from eventsrc.envelope.model import KeyframeId, Offset, RunId
from projections.fold.corrections import Keyframe
from projections.fold.deltas import KeyframeOrdinal, PlaceOrdinal
from projections.map.naming import Existence, NoSuchThing, Thing, things_of
from projections.map.view import MapView
from projections.store.history import History


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


def things_at(history: History, view: MapView) -> list[Thing]:
    """The Places and Objects of a map of this history; then those that only come later, which have
    their ids alone."""
    found = [_with_event(history, each) for each in things_of(view)]
    for place in history.places[len(view.all_places) :]:
        fate = f"founded later, at offset {place.formed.offset:,}"
        found.append(
            Thing("place", place.formed.place, place.place_id, existence=Existence.LATER, fate=fate)
        )
    for each in history.objects[len(view.all_objects) :]:
        fate = f"found later, at offset {each.found.offset:,}"
        found.append(
            Thing("object", each.found.object, each.object_id, existence=Existence.LATER, fate=fate)
        )
    return found


def _with_event(history: History, thing: Thing) -> Thing:
    """A thing of a map; one that was merged with the event that did it."""
    if thing.stands:
        return thing
    records = history.places if thing.kind == "place" else history.objects
    merge = records[thing.ordinal].absorbed_by
    at = "" if merge is None else f" at offset {merge.cause.offset:,}"
    return replace(thing, fate=f"{thing.fate}{at}")
