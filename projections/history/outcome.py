"""What became of a log under one setting: small enough to send between processes and to compare.

Keyframes and observations have the same ordinals under any settings, since the log alone decides
them; places and objects do not. So places are numbered here by the event that founded them and then
by their first member, which two folds share until they part.
"""

from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from eventsrc.envelope import Offset
from projections.evaluate.scores import object_scores, place_scores
from projections.evaluate.truth import Truth
from projections.model.digest import map_digest
from projections.model.view import MapView
from projections.settings import Settings

from .history import History
from .records import PlaceLife

Offsets: TypeAlias = "array[int]"


@dataclass(frozen=True, slots=True)
class Outcome:
    """One fold's result. ``places`` and ``objects`` name each keyframe's and each observation's
    group, None for none; ``posed`` are the keyframes that have a pose, so can be in a place.

    The rest tells how it came about: by keyframe the event that placed it and the place joined
    then, the merges as (offset, absorbed, survivor), by observation its object and its event.
    """

    settings: Settings
    digest: str
    counts: dict[str, int]
    merges: int
    places: tuple[str | None, ...]
    objects: tuple[str | None, ...]
    posed: Offsets
    placed_offsets: Offsets
    placed_in: Offsets
    merged: tuple[tuple[int, int, int], ...]
    fused_into: Offsets
    observation_offsets: Offsets
    scores: dict[str, dict[str, Any]] | None
    """``places`` and ``objects`` against the truth (`projections.evaluate.scores`)."""
    seconds: float
    view: MapView | None = None
    """The map itself, where it was asked for: to be read only."""


def outcome_of(view: MapView, history: History, truth: Truth | None, seconds: float) -> Outcome:
    """Condense a fold, which took ``seconds``, into its outcome."""
    numbers = _numbers(history.places)
    fused = array("q", (-1 if o.object is None else o.object for o in view.observations))
    offsets = history.keyframe_offsets
    return Outcome(
        settings=view.settings,
        digest=map_digest(view),
        counts=view.counts(),
        merges=len(history.merges),
        places=tuple(view.place_id(keyframe.place) for keyframe in view.keyframes),
        objects=tuple(None if n < 0 else view.objects[n].object_id for n in fused),
        posed=array("q", (k.ordinal for k in view.keyframes if k.pose is not None)),
        placed_offsets=history.placed_offsets,
        placed_in=array("q", (-1 if p < 0 else numbers[p] for p in history.placed_in)),
        merged=tuple(
            (merge.cause.offset, numbers[place], numbers[merge.survivor])
            for merge in history.merges
            for place in merge.absorbed
        ),
        fused_into=fused,
        observation_offsets=array("q", (offsets[o.keyframe] for o in view.observations)),
        scores=None if truth is None else _scores(view, truth),
        seconds=seconds,
    )


def _scores(view: MapView, truth: Truth) -> dict[str, dict[str, Any]]:
    return {"places": place_scores(view, truth), "objects": object_scores(view, truth)}


def places_part(first: Outcome, second: Outcome) -> Offset | None:
    """The first event after which two folds of one log have different places; None for never."""
    placings = zip(
        first.placed_offsets, first.placed_in, second.placed_offsets, second.placed_in, strict=True
    )
    parted = [min(o1, o2) for o1, p1, o2, p2 in placings if (o1, p1) != (o2, p2)]
    parted += [offset for offset, _, _ in set(first.merged) ^ set(second.merged)]
    return Offset(min(parted)) if parted else None


def objects_part(first: Outcome, second: Outcome) -> Offset | None:
    """The first event after which two folds of one log have different objects."""
    pairs = zip(first.fused_into, second.fused_into, first.observation_offsets, strict=True)
    return next((Offset(offset) for a, b, offset in pairs if a != b), None)


def _numbers(places: Sequence[PlaceLife]) -> list[int]:
    def age(ordinal: int) -> tuple[int, int]:
        life = places[ordinal]
        first = [d.keyframe for d in life.joined if d.offset == life.formed.offset]
        return life.formed.offset, min(first, default=life.formed.founder)

    numbers = [0] * len(places)
    for number, ordinal in enumerate(sorted(range(len(places)), key=age)):
        numbers[ordinal] = number
    return numbers
