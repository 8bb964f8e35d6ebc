"""The view and the reducers equal a recount from scratch after every keyframe."""

import math
import random
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from projections.fold.deltas import KeyframeAdded, ObjectFound, ObjectSeen, ObservationAdded
from projections.map.digest import map_digest
from projections.map.view import MapView
from tests.support.envelopes import detection, envelope
from tests.support.folds import (
    Folded,
    fold,
    recounted_adjacency,
    recounted_locations,
    recounted_places,
)

CLASSES = ("cup", "chair")
SETTINGS = {"eps_m": 0.8, "min_samples": 3, "fusion_radius_m": 2.0}


@st.composite
def runs(draw: st.DrawFn) -> list[dict[str, Any]]:
    """Up to three interleaved runs through a small flat: lost robots, repeats, shuffled arrival."""
    count = draw(st.integers(0, 40))
    rng = random.Random(draw(st.integers(0, 2**32)))
    documents = [_document(rng, index) for index in range(count)]
    if draw(st.booleans()):
        rng.shuffle(documents)
    for document in list(documents):
        if rng.random() < 0.1:
            repeat = {**document, "timestamp": 5.0} if rng.random() < 0.5 else document
            documents.insert(rng.randrange(len(documents) + 1), repeat)
    return documents


def _document(rng: random.Random, index: int) -> dict[str, Any]:
    run = rng.choice(["a", "a", "b", "c"])
    detections = [_detection(rng, f"{run}{index}-{d}") for d in range(rng.randrange(4))]
    x: float | None = round(rng.uniform(0, 5), 1)
    if rng.random() < 0.1:
        x = None
    return envelope(index, x, round(rng.uniform(0, 1.5), 1), run_id=run, detections=detections)


def _detection(rng: random.Random, det_id: str) -> dict[str, Any]:
    vector = None
    if rng.random() < 0.9:
        vector = [rng.choice([1, 2]), rng.uniform(0, 2), rng.uniform(-1, 1), 0.5]
    return detection(rng.choice(CLASSES), vector, det_id=det_id)


@given(documents=runs())
def test_the_view_equals_a_recount_after_every_event(documents: list[dict[str, Any]]) -> None:
    folded = Folded.start(fold([], **SETTINGS).view.settings)
    for document in documents:
        view = folded.extend([document]).view
        assert view.adjacency == recounted_adjacency(view)
        assert [found.place for found in view.objects.values()] == recounted_locations(view)
        counted = recounted_places(view)
        assert {
            p.ordinal: (p.keyframe_count, p.sum_x_um, p.sum_y_um) for p in view.places.values()
        } == counted
        for place in view.places.values():
            assert [k.ordinal for k in view.keyframes if k.place == place.ordinal] == place.members


@given(documents=runs())
def test_the_view_from_deltas_is_the_reducers_own_state(documents: list[dict[str, Any]]) -> None:
    folded = fold(documents, **SETTINGS)
    view, places = folded.view, folded.map.places
    for point, keyframe in enumerate(places.keyframes):
        assert places.label(point) == view.keyframes[keyframe].place
    own = [
        (o.count, o.sum_x_um, o.sum_y_um, o.first_seen, o.last_seen)
        for o in folded.map.objects.sums
    ]
    assert own == [
        (o.obs_count, o.sum_x_um, o.sum_y_um, o.first_seen, o.last_seen)
        for o in view.objects.values()
    ]
    assert folded.map.located_in.located == [o.place for o in view.objects.values()]
    edges = {
        (a, b): n for a, row in folded.map.adjacency.edges.items() for b, n in row.items() if a < b
    }
    assert edges == view.adjacency


@given(documents=runs())
def test_applying_every_event_twice_changes_nothing(documents: list[dict[str, Any]]) -> None:
    folded = fold(documents, **SETTINGS)
    twice = MapView(folded.view.settings)
    for offset, deltas in enumerate(folded.deltas):
        twice.apply_event(offset, deltas)
        twice.apply_event(offset, deltas)
    assert map_digest(twice) == map_digest(folded.view)
    assert twice.counts() == folded.view.counts()


@given(documents=runs(), cut=st.integers(0, 45))
def test_folding_in_two_parts_changes_nothing(documents: list[dict[str, Any]], cut: int) -> None:
    whole = fold(documents, **SETTINGS)
    parts = Folded.start(whole.view.settings).extend(documents[:cut]).extend(documents[cut:])
    assert map_digest(parts.view) == map_digest(whole.view)


@given(documents=runs())
def test_fusion_equals_brute_force(documents: list[dict[str, Any]]) -> None:
    """Every Object from scratch, all of them asked, in fractions and Python integers."""
    folded = fold(documents, **SETTINGS)
    added = {d.keyframe: d for d in folded.all(KeyframeAdded)}
    seen = {d.observation: d for d in folded.all(ObjectSeen)}
    objects: list[tuple[str, list[ObservationAdded]]] = []
    for observation in folded.all(ObservationAdded):
        pose = added[observation.keyframe].pose
        if observation.embedding is None or pose is None:
            assert observation.observation not in seen
            continue
        ranked = []
        for ordinal, (class_name, members) in enumerate(objects):
            cosine = _cosine_q40(members, observation)
            if class_name == observation.class_name and cosine >= Fraction(0.7) * 2**40:
                poses = [added[m.keyframe].pose for m in members]
                dx = Fraction(sum(p.x_um for p in poses), len(poses)) - pose.x_um
                dy = Fraction(sum(p.y_um for p in poses), len(poses)) - pose.y_um
                if dx * dx + dy * dy <= 2_000_000**2:
                    ranked.append((-cosine, ordinal))
        delta = seen[observation.observation]
        if ranked:
            cosine, ordinal = min(ranked)
            assert (delta.object, delta.similarity_q40) == (ordinal, -cosine)
            objects[ordinal][1].append(observation)
        else:
            assert (delta.object, delta.similarity_q40) == (len(objects), 2**40)
            objects.append((observation.class_name, [observation]))
        members = objects[delta.object][1]
        assert delta.obs_count == len(members)
        times = [added[m.keyframe].timestamp for m in members]
        assert (delta.first_seen, delta.last_seen) == (min(times), max(times))
    assert len(folded.all(ObjectFound)) == len(objects)


def _cosine_q40(members: list[ObservationAdded], observation: ObservationAdded) -> int:
    vectors = [[int(v) for v in m.embedding] for m in members]
    total = [sum(column) for column in zip(*vectors, strict=True)]
    unit = [int(v) for v in observation.embedding]
    dot = sum(a * b for a, b in zip(total, unit, strict=True))
    squares = sum(a * a for a in total) * sum(a * a for a in unit)
    return round(dot / math.sqrt(squares) * 2**40)


@given(documents=runs())
def test_centroids_are_the_exact_mean(documents: list[dict[str, Any]]) -> None:
    view = fold(documents, **SETTINGS).view
    for place in view.places.values():
        poses = [view.keyframes[m].pose for m in place.members]
        mean = Fraction(sum(p.x_um for p in poses), len(poses) * 1_000_000)
        assert place.centroid_x == float(mean)
        assert place.centroid_x == pytest.approx(np.mean([p.x_m for p in poses]))
