"""Folding envelopes in tests, and slow, obvious recounts of all that the fold keeps up to date."""

from collections import Counter
from collections.abc import Callable, Iterable
from copy import deepcopy
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from eventsrc.envelope.ingest import Accepted, ingest
from projections.fold.corrections import NO_CORRECTIONS, Corrections
from projections.fold.deltas import Delta
from projections.fold.semantic_map import SemanticMap
from projections.fold.settings import Settings
from projections.map.view import MapView
from projections.store.kept_files import pack, unpack

from .envelopes import payload

NearTest = Callable[[int, int], bool]


def accepted(document: dict[str, Any]) -> Accepted:
    """The document as validation accepts it."""
    result = ingest(payload(document))
    assert isinstance(result, Accepted), result
    return result


@dataclass
class Folded:
    """A fold that can go on, its view, and every event's deltas."""

    map: SemanticMap
    view: MapView
    deltas: list[list[Delta]]

    @classmethod
    def start(
        cls,
        settings: Settings | None = None,
        corrections: Corrections = NO_CORRECTIONS,
    ) -> "Folded":
        """Nothing folded yet."""
        settings = settings or Settings()
        semantic_map = SemanticMap(settings, corrections)
        return cls(semantic_map, MapView(settings, corrections=corrections), [])

    def extend(self, documents: Iterable[dict[str, Any]]) -> "Folded":
        """Fold these too."""
        for document in documents:
            deltas = self.map.fold(self.map.next_offset, accepted(document))
            self.view.apply_event(self.map.next_offset - 1, deltas)
            self.deltas.append(deltas)
        return self

    def all(self, kind: type) -> list[Any]:
        """All deltas of a type, in order."""
        return [delta for deltas in self.deltas for delta in deltas if type(delta) is kind]


def state_bytes(folded: Folded) -> bytes:
    """The state of a fold as a kept history has it."""
    return pack(folded.map.dump())


def resumed(folded: Folded) -> Folded:
    """The fold out of its `state_bytes`, with a copy of the view and no deltas yet."""
    again = SemanticMap(folded.map.settings, folded.map.corrections)
    again.load(unpack(state_bytes(folded)))
    again.use_names(again.next_offset, again.corrections)
    return Folded(again, deepcopy(folded.view), [])


def fold(documents: Iterable[dict[str, Any]], **settings: Any) -> Folded:
    """Fold documents from nothing."""
    return Folded.start(Settings(**settings)).extend(documents)


def batch_dbscan(are_near: np.ndarray, min_samples: int) -> tuple[np.ndarray, set[int]]:
    """scikit-learn's labels and core points; ``are_near`` is a boolean (n, n) matrix."""
    from sklearn.cluster import DBSCAN  # takes a second, and few tests need it

    model = DBSCAN(eps=0.5, min_samples=min_samples, metric="precomputed")
    model.fit(np.where(are_near, 0.0, 1.0))
    return model.labels_, set(model.core_sample_indices_.tolist())


def near_matrix(n: int, is_near: NearTest) -> np.ndarray:
    """Who is near whom as a matrix; every point is its own neighbour."""
    return np.array([[i == j or is_near(i, j) for j in range(n)] for i in range(n)]).reshape(n, n)


class NaivePlaces:
    """The rules of `projections.fold.places`, word by word, from scratch at every point.

    ``labels`` is the founding number of each point's place, None for noise; ``founders`` are the
    points that founded the places.
    """

    def __init__(self, min_samples: int) -> None:
        self.min_samples = min_samples
        self.labels: list[int | None] = []
        self.cores: set[int] = set()
        self.founders: list[int] = []

    def add(self, are_near: np.ndarray) -> None:
        """Take in the last point of the matrix."""
        n = len(are_near)
        self.labels.append(None)
        older = self.cores
        self.cores = {i for i in range(n) if are_near[i].sum() >= self.min_samples}
        renamed: dict[int, int] = {}
        for part in self._parts(are_near):
            known = {self.labels[i] for i in part & older}
            if known:
                place = min(known)
                renamed |= dict.fromkeys(known, place)
            else:
                place = len(self.founders)
                self.founders.append(min(part))
            for i in part:
                self.labels[i] = place
        for i in set(range(n)) - self.cores:
            near = {self.labels[j] for j in self.cores if are_near[i][j]}
            if self.labels[i] is not None:
                self.labels[i] = renamed.get(self.labels[i], self.labels[i])
            elif near:
                self.labels[i] = min(near)

    def _parts(self, are_near: np.ndarray) -> list[set[int]]:
        """Connected core points, in the order of their earliest."""
        rest, parts = sorted(self.cores), []
        while rest:
            part, frontier = {rest[0]}, [rest[0]]
            while frontier:
                i = frontier.pop()
                more = {j for j in rest if are_near[i][j]} - part
                part |= more
                frontier += more
            rest = [i for i in rest if i not in part]
            parts.append(part)
        return parts


def recounted_adjacency(view: MapView) -> dict[tuple[int, int], int]:
    """Shared transitions, counted from the labels."""
    counted: Counter[tuple[int, int]] = Counter()
    for run in view.runs:
        places = [
            k.place
            for k in sorted(view.keyframes, key=lambda k: k.keyframe_id)
            if k.run == run.ordinal and k.place is not None
        ]
        for a, b in pairwise(places):
            if a != b:
                counted[min(a, b), max(a, b)] += 1
    return dict(counted)


def recounted_locations(view: MapView) -> list[int | None]:
    """Each Object's place, from the labels of the keyframes that saw it."""
    located: list[int | None] = []
    for found in view.objects.values():
        votes = Counter(
            place
            for i in found.observations
            if (place := view.keyframes[view.observations[i].keyframe].place) is not None
        )
        located.append(min(votes, key=lambda p: (-votes[p], p)) if votes else None)
    return located


def recounted_places(view: MapView) -> dict[int, tuple[int, int, int]]:
    """Members and sums of positions of each place that has any."""
    counted: dict[int, tuple[int, int, int]] = {}
    for k in view.keyframes:
        if k.place is not None and k.pose is not None:
            n, x, y = counted.get(k.place, (0, 0, 0))
            counted[k.place] = n + 1, x + k.pose.x_um, y + k.pose.y_um
    return counted
