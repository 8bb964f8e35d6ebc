"""The map at any offset, made from the columns of a history without folding.

Counts, places and objects are computed from whole columns. Keyframes and observations are made one
by one on first access, and all of them before the view is changed.
"""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import pairwise, repeat
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from eventsrc.envelope.model import Offset
from projections.fold.deltas import Delta, PlaceOrdinal, Pose, SkipKind
from projections.fold.survivors import PlaceSurvivors
from projections.map.records import KeyframeRecord, ObservationRecord
from projections.map.view import MapView

from .columns import NONE
from .history import History
from .lazy_rows import Chunks
from .moment import Moment
from .recorded_vectors import RecordedVectors
from .stored_records import adjacency_of, floors_of, objects_of, places_of, runs_of, skipped_of
from .timeline_cache import TimelineCache

_LAZY: Final = ("keyframes", "observations")


class StoredView(MapView):
    """The map after ``end`` events of a history of tables; the caller may change it.

    Its digest is kept in ``cache``, if there is one. Its observations have embeddings only in
    ``recorded``, as which `vectors` gives them.
    """

    def __init__(
        self,
        history: History,
        end: Offset,
        cache: TimelineCache | None = None,
        recorded: RecordedVectors | None = None,
    ) -> None:
        super().__init__(
            history.settings,
            keep_embeddings=recorded is not None,
            corrections=history.corrections,
        )
        self._is_changed = False
        self._cache, self._recorded = cache, recorded
        self._moment = moment = Moment(history, end)
        self.all_places = places_of(moment)
        for merge in moment.merges:
            self.survivors.merge(merge.survivor, merge.absorbed)
        gone = self.survivors.absorbed_by
        self.places = {p.ordinal: p for p in self.all_places if p.ordinal not in gone}
        self.all_objects = objects_of(moment)
        for each in moment.object_merges:
            self.object_survivors.merge(each.survivor, (each.absorbed,))
        absorbed = self.object_survivors.absorbed_by
        self.objects = {o.ordinal: o for o in self.all_objects if o.ordinal not in absorbed}
        for found in self.objects.values():
            self.contents.update(found)
        self.runs = runs_of(moment)
        self.adjacency = adjacency_of(moment)
        for kind, count in skipped_of(moment).items():
            self.skipped[cast("SkipKind", kind)] = count
        self.floors = {name: number for number, name in enumerate(floors_of(moment))}
        for given in history.maps[: moment.count("map")] if moment.count("map") else ():
            self.maps[given.map.floor] = given
        # Made on first access: they are most of a map.
        del self.keyframes, self.observations
        self.advance(end)

    def __getattr__(self, name: str) -> Any:
        if name not in _LAZY or "_moment" not in self.__dict__:
            raise AttributeError(name)
        moment, count = self._moment, self._moment.count(name.removesuffix("s"))
        make: Callable[[int, int], list[Any]]
        if name == "keyframes":  # not a method: a view in a cycle would stay in memory
            make = partial(_keyframes, moment, self.survivors)
        else:
            make = partial(_observations, moment)
        found: Chunks[Any] = Chunks(count, make)
        setattr(self, name, found)
        return found

    def apply(self, delta: Delta) -> None:
        """Apply one delta."""
        self._make_all()
        super().apply(delta)

    def apply_event(self, offset: Offset, deltas: Iterable[Delta]) -> None:
        """Apply all deltas of the event at ``offset`` and advance past it."""
        self._make_all()
        super().apply_event(offset, deltas)

    def known_digest(self) -> str | None:
        """The digest of this map from the cache; None if it was not computed before."""
        if self._cache is None or self._is_changed:
            return None
        return self._cache.digest_at(self.next_offset)

    def keep_digest(self, digest: str) -> None:
        """Store the digest in the cache."""
        if self._cache is not None and not self._is_changed:
            self._cache.keep_digest(self.next_offset, digest)

    def det_ids(self) -> Sequence[str]:
        """The det_id of each observation."""
        if self._is_changed:
            return super().det_ids()
        count = self._moment.count("observation")
        return [each or "" for each in self._moment.tables.texts("observation", "det_id", 0, count)]

    def embedded(self) -> NDArray[np.int64]:
        """The observations that have a vector of the map's space."""
        if self._recorded is None or self._is_changed:
            return super().embedded()
        return np.flatnonzero(self._moment.column("observation", "crc") != NONE)

    def vectors(self, observations: NDArray[np.int64]) -> NDArray[np.int32]:
        """The unit vectors of some of `embedded`. Raises LogError, FoldError."""
        if self._recorded is None:
            return super().vectors(observations)
        return self._recorded.of(observations)

    def floor_of(self, place: PlaceOrdinal) -> str | None:
        """The name of the floor that a place is on; None if the log has none."""
        return super().floor_of(place) if self.floors else None

    @property
    def first_floor(self) -> str | None:
        """The floor of the first pose; None also where there is none."""
        return super().first_floor if self.floors else None

    def _sums(self) -> tuple[int, int, int]:
        if self._is_changed:
            return super()._sums()
        moment = self._moment
        return (
            int(np.count_nonzero(moment.column("keyframe", "posed"))),
            int(np.count_nonzero(moment.is_fused)),
            int(np.count_nonzero(moment.column("observation", "foreign"))),
        )

    def _make_all(self) -> None:
        """Make every record, so that they can be changed."""
        if not self._is_changed:
            self._is_changed = True
            self.keyframes, self.observations = list(self.keyframes), list(self.observations)


def _keyframes(
    moment: Moment, survivors: PlaceSurvivors, first: int, last: int
) -> list[KeyframeRecord]:
    offsets, runs, run_ids, ids, timestamps, posed, x_um, y_um, yaws, floors = moment.tables.lists(
        "keyframe", first, last
    )
    _, joined = moment.placed
    poses = map(Pose, x_um, y_um, yaws)
    starts = moment.observation_starts[first : last + 1].tolist()
    return list(
        map(
            KeyframeRecord,
            range(first, last),
            offsets,
            runs,
            run_ids,
            ids,
            timestamps,
            [pose if has_pose else None for pose, has_pose in zip(poses, posed, strict=True)],
            repeat(survivors),
            [list(range(*span)) or () for span in pairwise(starts)],
            [None if place == NONE else place for place in joined[first:last].tolist()],
            floors,
        )
    )


def _observations(moment: Moment, first: int, last: int) -> list[ObservationRecord]:
    _, keyframes, det_ids, names, confidences, x0, y0, x1, y1, models, crcs, foreign = (
        moment.tables.lists("observation", first, last)
    )
    objects, similarities = (column[first:last].tolist() for column in moment.fused)
    return list(
        map(
            ObservationRecord,
            range(first, last),
            keyframes,
            det_ids,
            names,
            confidences,
            zip(x0, y0, x1, y1, strict=True),
            models,
            repeat(None),
            crcs,
            foreign,
            [None if found == NONE else found for found in objects],
            [
                None if found == NONE else q40
                for found, q40 in zip(objects, similarities, strict=True)
            ],
        )
    )
