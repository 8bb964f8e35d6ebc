"""Fold one log under several rules in parallel processes.

Rules are settings and corrections. Each process reads and validates the log once for all of its
rules. A short log is folded in this process: starting another takes longer.

A `FoldResult` is small enough to send between processes. Two can be compared: a keyframe is
identified by its event, an observation by its event and det_id; which of them are in the map
depends on the corrections. Places are numbered here by the event that founded them and then by
their first member, and two folds have the same numbers until they differ.
"""

import time
from array import array
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from eventsrc.base import worker_process
from eventsrc.base.errors import MapfoldError
from eventsrc.base.machine import gc_paused, usable_processors
from eventsrc.envelope.model import FIRST_OFFSET, DetId, Offset
from eventsrc.log import LogReader
from projections.fold import deltas as d
from projections.fold.corrections import NO_CORRECTIONS, Corrections, map_fingerprint
from projections.fold.settings import Settings
from projections.map.digest import map_digest
from projections.map.fold import fold_parsed, new_map, read_ahead
from projections.map.parsing import ParsedEvent, parsed_stretches
from projections.map.view import MapView
from projections.store.history import History
from projections.store.history_recorder import map_at
from projections.store.history_records import PlaceHistory
from projections.store.tables import Tables, TableWriter

from .known_history import Progress

if TYPE_CHECKING:
    from projections.localize.evaluate.truth import Truth

Offsets: TypeAlias = "array[int]"

MIN_PARALLEL_EVENTS = 20_000
"""Events times settings from which processes are started: about two seconds of folding."""
_PLACE_DELTAS = frozenset(
    {d.RunSeen, d.KeyframeAdded, d.PlaceFormed, d.KeyframePlaced, d.PlacesMerged}
)
"""The deltas that `fold_result` needs from a history; the rest is in the view."""
_OBJECT_DELTAS = frozenset({d.ObjectFound, d.ObjectSeen, d.ObjectsMerged})
"""Also needed where objects may merge."""

NO_NUMBER: Final = -1
"""In the arrays of a `FoldResult`: no place, or no object."""


@dataclass(frozen=True, slots=True, eq=False)
class Rules:
    """Settings and corrections that a log is folded under."""

    settings: Settings
    corrections: Corrections = NO_CORRECTIONS

    @property
    def key(self) -> str:
        """Equal for rules that give the same map."""
        return map_fingerprint(self.settings, self.corrections)


@dataclass(frozen=True, slots=True)
class FoldResult:
    """The map of a log under some rules, and when its places and objects came to be.

    ``places`` are place ids by keyframe, ``objects`` object ids by observation, None for none;
    ``posed`` are the ordinals of keyframes with a pose. By keyframe, ``keyframe_offsets`` is its
    event, ``placed_offsets`` the event that placed it and ``placed_in`` the number of the place it
    joined; ``merged`` are the merges as (offset, absorbed, survivor). By observation,
    ``fused_into`` is the number of its object after its own event (`NO_NUMBER` for none),
    ``observation_offsets`` its event and ``det_ids`` its det_id; ``fused_later`` are the merges of
    objects by later events as (offset, absorbed, survivor). An object's number follows from its id.
    ``names`` are the names of places by id. ``seconds`` is the time of the fold.
    """

    settings: Settings
    digest: str
    counts: dict[str, int]
    merges: int
    places: tuple[str | None, ...]
    objects: tuple[str | None, ...]
    posed: Offsets
    keyframe_offsets: Offsets
    placed_offsets: Offsets
    placed_in: Offsets
    merged: tuple[tuple[int, int, int], ...]
    fused_into: Offsets
    observation_offsets: Offsets
    det_ids: tuple[DetId, ...]
    fused_later: tuple[tuple[int, int, int], ...]
    names: dict[str, str]
    scores: dict[str, dict[str, Any]] | None
    """``places`` and ``objects`` against the truth (`projections.localize.evaluate.scores`)."""
    seconds: float
    view: MapView | None = None
    """The map itself, if asked for; do not change it."""


def fold_result(
    view: MapView, history: History, truth: "Truth | None", seconds: float
) -> FoldResult:
    """The result of a fold that took ``seconds``."""
    numbers = _place_numbers(history.places)
    fused = array("q", (NO_NUMBER if o.object is None else o.object for o in view.observations))
    numbers_of = [_object_number(o.object_id) for o in view.all_objects]
    first = array("q", (NO_NUMBER if o < 0 else numbers_of[o] for o in fused))
    for each in history.objects:
        for seen in each.sightings:
            at_once = history.object_survivor(each.found.object, Offset(seen.offset + 1))
            first[seen.observation] = numbers_of[at_once]
    offsets = array("q", history.keyframe_offsets)
    return FoldResult(
        settings=view.settings,
        digest=map_digest(view),
        counts=view.counts(),
        merges=len(history.merges),
        places=tuple(view.place_id(keyframe.place) for keyframe in view.keyframes),
        objects=tuple(None if n < 0 else view.all_objects[n].object_id for n in fused),
        posed=array("q", (k.ordinal for k in view.keyframes if k.pose is not None)),
        keyframe_offsets=offsets,
        placed_offsets=array("q", history.placed_offsets),
        placed_in=array("q", (NO_NUMBER if p < 0 else numbers[p] for p in history.placed_in)),
        merged=tuple(
            (merge.cause.offset, numbers[place], numbers[merge.survivor])
            for merge in history.merges
            for place in merge.absorbed
        ),
        fused_into=first,
        observation_offsets=array("q", (offsets[o.keyframe] for o in view.observations)),
        det_ids=tuple(o.det_id for o in view.observations),
        fused_later=tuple(
            (merge.offset, numbers_of[merge.absorbed], numbers_of[merge.survivor])
            for merge in history.object_merges
            if history.objects[merge.absorbed].found.offset < merge.offset
        ),
        names={p.place_id: p.name for p in view.places.values() if p.name is not None},
        scores=None if truth is None else _scores(view, truth),
        seconds=seconds,
    )


def _scores(view: MapView, truth: "Truth") -> dict[str, dict[str, Any]]:
    # Here and not above: the scores are slow to import, and of few commands.
    from projections.localize.evaluate.scores import object_scores, place_scores

    return {"places": place_scores(view, truth), "objects": object_scores(view, truth)}


def _object_number(object_id: str) -> int:
    """An object's number: equal in all folds for Objects that the same detection founded."""
    return int(object_id[-15:], 16)


def _place_numbers(places: Sequence[PlaceHistory]) -> list[int]:
    """By ordinal the rank of a place by founding event, then by first member."""

    def founding(ordinal: int) -> tuple[int, int]:
        place = places[ordinal]
        members = [each.keyframe for each in place.joined if each.offset == place.formed.offset]
        return place.formed.offset, min(members, default=place.formed.founder)

    numbers = [0] * len(places)
    for number, ordinal in enumerate(sorted(range(len(places)), key=founding)):
        numbers[ordinal] = number
    return numbers


def fold_all(
    log: Path,
    rules: Sequence[Rules],
    end: Offset,
    *,
    truth: "Truth | None" = None,
    processes: int | None = None,
    progress: Progress | None = None,
    keep_views: bool = False,
) -> list[FoldResult]:
    """The results of the first ``end`` events under each of ``rules``, in their order.

    With ``keep_views`` each has its map too, without embeddings. Raises FoldError at an event that
    cannot be folded, and what ``progress`` raises, which ends the folds.
    """
    workers = min(processes or usable_processors(), len(rules))
    if workers <= 1 or (processes is None and end * len(rules) < MIN_PARALLEL_EVENTS):
        return fold_in_this_process(log, rules, end, truth, progress, keep_views=keep_views)
    shares = [list(rules[index::workers]) for index in range(workers)]
    results = _in_processes(log, shares, end, progress, truth=truth, keep_views=keep_views)
    return [results[index % workers][index // workers] for index in range(len(rules))]


def fold_in_this_process(
    log: Path,
    rules: Sequence[Rules],
    end: Offset,
    truth: "Truth | None" = None,
    progress: Progress | None = None,
    *,
    keep_views: bool = False,
) -> list[FoldResult]:
    """As `fold_all`, in this process: one pass over the log for all of ``rules``."""
    with LogReader(log) as reader:
        folds = [_Fold(reader, each) for each in rules]
        parsed = parsed_stretches(reader.read(FIRST_OFFSET, end))
        with gc_paused():
            for stretch in read_ahead(parsed, *(fold.map for fold in folds)):
                _fold_stretch(stretch, folds)
                if progress is not None:
                    progress(stretch[-1].offset + 1, end)
            return [fold.result(truth, keep_view=keep_views) for fold in folds]


class _Fold:
    """A fold under some rules, and the seconds that it took."""

    def __init__(self, reader: LogReader, rules: Rules) -> None:
        settings, corrections = rules.settings, rules.corrections
        self.map = new_map(reader, settings, corrections)
        self.view = MapView(settings, keep_embeddings=False, corrections=corrections)
        self._map_at = partial(map_at, reader)
        self._writer = TableWriter(Tables())
        self.seconds = 0.0
        objects_merge = bool(corrections.same) or settings.fusion == "evidence"
        self._needed = _PLACE_DELTAS | _OBJECT_DELTAS if objects_merge else _PLACE_DELTAS

    def fold(self, read: ParsedEvent) -> None:
        offset, deltas = read.offset, fold_parsed(read, self.map)
        self.view.apply_event(offset, deltas)
        self._writer.add(offset, [delta for delta in deltas if type(delta) in self._needed])

    def result(self, truth: "Truth | None", *, keep_view: bool) -> FoldResult:
        view, tables = self.view, Tables(self._writer.finish())
        history = History(view.settings, view.corrections, tables, self._map_at)
        result = fold_result(view, history, truth, self.seconds)
        return replace(result, view=self.view) if keep_view else result


def _fold_stretch(stretch: Sequence[ParsedEvent], folds: Sequence[_Fold]) -> None:
    for fold in folds:
        started = time.perf_counter()
        for event in stretch:
            fold.fold(event)
        fold.seconds += time.perf_counter() - started


def _in_processes(
    log: Path, shares: list[list[Rules]], end: Offset, progress: Progress | None, **more: Any
) -> list[list[FoldResult]]:
    calls = [partial(_fold_share, log, share, end, **more) for share in shares]
    total = end * len(shares)

    def report(folded: int) -> None:
        if progress is not None:
            progress(folded, total)

    ended: dict[int, worker_process.Called[list[FoldResult]]] = {}
    try:
        for called in worker_process.call_in_processes(calls, len(calls), report):
            if isinstance(called.error, worker_process.ProcessGone):
                raise called.error
            ended[called.number] = called
    except worker_process.ProcessKilled:
        raise MapfoldError(
            f"{log}: a process that folded it was killed, perhaps for lack of memory; "
            "try fewer --processes"
        ) from None
    except worker_process.ProcessGone as error:
        raise MapfoldError(
            f"{log}: a process that folds it died or did not start: {error}; try --processes 1"
        ) from None
    for _, called in sorted(ended.items()):  # of several errors always the same one
        if called.error is not None:
            raise called.error
    return [ended[number].result or [] for number in range(len(calls))]


def _fold_share(
    log: Path, rules: list[Rules], end: Offset, report: worker_process.Report, **more: Any
) -> list[FoldResult]:
    return fold_in_this_process(log, rules, end, progress=lambda folded, _: report(folded), **more)
