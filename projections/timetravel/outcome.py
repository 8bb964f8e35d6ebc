"""What became of a log under one setting: small enough to send between processes and to compare.

Keyframes and observations have the same ordinals under any settings, since the log alone decides
them; places and objects do not.
"""

from array import array
from collections.abc import Sequence
from dataclasses import dataclass

from projections.settings import Settings
from projections.view import MapView

from .history import NEVER, History
from .lives import PlaceLife


@dataclass(frozen=True, slots=True)
class Step:
    """What one event did to the partition of keyframes into places.

    ``placed`` pairs keyframes with places, ``merged`` absorbed places with survivors; both sorted.
    Places are numbered in the order of founding, so steps of two folds compare until they differ.
    """

    placed: tuple[tuple[int, int], ...]
    merged: tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True)
class Outcome:
    """One fold's result. ``places`` and ``objects`` name each keyframe's and observation's group,
    None for none; ``object_numbers`` and ``steps`` tell how they came about."""

    settings: Settings
    digest: str
    counts: dict[str, int]
    merges: int
    places: tuple[str | None, ...]
    objects: tuple[str | None, ...]
    posed: tuple[int, ...]
    """Ordinals of the keyframes that have a pose: only those can be in a place."""
    object_numbers: "array[int]"
    observation_offsets: "array[int]"
    steps: dict[int, Step]
    seconds: float


def outcome_of(view: MapView, history: History, digest: str, seconds: float) -> Outcome:
    """Condense a fold into its outcome."""
    place_ids = [place.place_id for place in view.all_places]
    places = (keyframe.place for keyframe in view.keyframes)
    numbers = array("q", (-1 if o.object is None else o.object for o in view.observations))
    offsets = history.keyframe_offsets
    return Outcome(
        settings=view.settings,
        digest=digest,
        counts=view.counts(),
        merges=len(history.merges),
        places=tuple(None if place is None else place_ids[place] for place in places),
        objects=tuple(None if n < 0 else view.objects[n].object_id for n in numbers),
        posed=tuple(k.ordinal for k in view.keyframes if k.pose is not None),
        object_numbers=numbers,
        observation_offsets=array("q", (offsets[o.keyframe] for o in view.observations)),
        steps=_steps(history),
        seconds=seconds,
    )


def first_parting(first: Outcome, second: Outcome) -> tuple[int | None, int | None]:
    """The first offsets at which two folds of one log part ways: in places, and in objects."""
    offsets = sorted(first.steps.keys() | second.steps.keys())
    in_places = next((o for o in offsets if first.steps.get(o) != second.steps.get(o)), None)
    pairs = zip(first.object_numbers, second.object_numbers, strict=True)
    differing = next((i for i, (a, b) in enumerate(pairs) if a != b), None)
    in_objects = None if differing is None else first.observation_offsets[differing]
    return in_places, in_objects


def _steps(history: History) -> dict[int, Step]:
    numbers = _numbers(history.places)
    placed: dict[int, list[tuple[int, int]]] = {}
    merged: dict[int, list[tuple[int, int]]] = {}
    for keyframe, offset in enumerate(history.placed_offsets):
        if offset != NEVER:
            pair = (keyframe, numbers[history.placed_in[keyframe]])
            placed.setdefault(offset, []).append(pair)
    for merge in history.merges:
        pairs = [(numbers[place], numbers[merge.survivor]) for place in merge.absorbed]
        merged.setdefault(merge.cause.offset, []).extend(pairs)
    return {
        offset: Step(tuple(sorted(placed.get(offset, ()))), tuple(sorted(merged.get(offset, ()))))
        for offset in placed.keys() | merged.keys()
    }


def _numbers(places: Sequence[PlaceLife]) -> list[int]:
    """Each place's number by founding event and then by first member: places that one event founds
    are founded in an order that may depend on the settings, and that is no difference."""

    def age(ordinal: int) -> tuple[int, int]:
        life = places[ordinal]
        first = [d.keyframe for d in life.joined if d.offset == life.formed.offset]
        return life.formed.offset, min(first, default=life.formed.founder)

    numbers = [0] * len(places)
    for number, ordinal in enumerate(sorted(range(len(places)), key=age)):
        numbers[ordinal] = number
    return numbers
