"""Fusion by evidence of sightings without an embedding, against a slow and plain search."""

import copy
import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from projections.fold.deltas import ObjectOrdinal, ObjectSeen, ObjectsMerged
from projections.fold.evidence import EvidenceConstants
from projections.fold.evidence_objects import EvidenceObjects
from projections.fold.exact import Q40
from projections.fold.objects import NO_VECTOR
from projections.fold.things import FusedThing
from tests.support.evidence_pictures import (
    CAMERA,
    Picture,
    a_room,
    fold_all,
    fold_one,
    pictures_of,
)
from tests.support.thorough import examples

_SEEDS = st.integers(0, 10_000)
_FIRST_GUESS = 0.5
"""The mean cosine of different things before any pair was seen."""
_MOST = 4
"""Sightings of a picture; the plain search tries all ways to assign them."""


def _few(picture: Picture) -> Picture:
    return picture._replace(sightings=picture.sightings[:_MOST], things=picture.things[:_MOST])


def _label_ratio(thing: FusedThing, label: str, counts: dict[str, int]) -> float:
    """As the docstring of `LabelCounts` says, by logarithms of the standard library."""
    usual = (counts.get(label, 0) + 1) / (sum(counts.values()) + 10)
    own = (thing.classes.get(label, 0) + 0.3 * usual) / (thing.count + 0.3)
    return math.log(own / usual)


def _worth(
    objects: EvidenceObjects, picture: Picture, counts: dict[str, int]
) -> list[dict[ObjectOrdinal, float]]:
    """For each sighting the evidence above 0 of every Object, one by one."""
    after = copy.deepcopy(objects)
    sights = after._sights.of(picture.pose, CAMERA, picture.sightings)
    after._slopes.learn(sights)
    agreement, slopes = after._matching._agreement, after._slopes.mean_square
    worth: list[dict[ObjectOrdinal, float]] = []
    for sight, sighting in zip(sights, picture.sightings, strict=True):
        own: dict[ObjectOrdinal, float] = {}
        for number, thing in enumerate(after._index._things):
            if thing is None:
                continue
            estimate = thing.where()
            ratios = agreement.pairs(np.array([estimate]), [sight], slopes).ratios
            if not ratios or agreement.is_ruled_out(estimate, sight):
                continue
            label = sighting.class_name
            value = ratios[0] + 0.5 * _label_ratio(thing, label, counts)
            value += 1.0 if label in thing.classes else 0.0
            value -= 1.5 if thing.count == 1 else 0.0
            if value > 0.0:
                own[ObjectOrdinal(number)] = value
        worth.append(own)
    return worth


def _best_sum(worth: list[dict[ObjectOrdinal, float]]) -> float:
    """The largest sum of all ways to give each sighting a different Object, or none."""
    best = 0.0
    for way in itertools.product(*([None, *own] for own in worth)):
        taken = [ordinal for ordinal in way if ordinal is not None]
        if len(set(taken)) == len(taken):
            pairs = zip(worth, way, strict=True)
            best = max(best, sum(own[o] for own, o in pairs if o is not None))
    return best


@settings(max_examples=examples(15), deadline=None)
@given(_SEEDS)
def test_of_all_ways_to_assign_bare_sightings_the_likeliest_is_taken(seed: int) -> None:
    objects, counts = EvidenceObjects(EvidenceConstants()), dict[str, int]()
    for picture in map(_few, pictures_of(a_room(seed, 10), seed, 30, bare=1.0)):
        for sighting in picture.sightings:
            counts[sighting.class_name] = counts.get(sighting.class_name, 0) + 1
        worth = _worth(objects, picture, counts)
        before = len(objects._index._things)
        seen = [d for d in fold_one(objects, picture) if isinstance(d, ObjectSeen)]
        pairs = zip(worth, (delta.object for delta in seen), strict=True)
        taken = sum(own[ordinal] for own, ordinal in pairs if ordinal < before)
        assert taken == pytest.approx(_best_sum(worth), abs=1e-3)


@settings(max_examples=examples(15), deadline=None)
@given(_SEEDS, st.sampled_from([0.0, 0.5, 1.0]))
def test_only_two_looks_have_a_similarity(seed: int, bare: float) -> None:
    objects = EvidenceObjects(EvidenceConstants())
    for picture in pictures_of(a_room(seed, 8), seed, 40, bare=bare):
        before = {o for o, thing in enumerate(objects._index._things) if thing and thing.marks}
        count = len(objects._index._things)
        seen = [d for d in fold_one(objects, picture) if isinstance(d, ObjectSeen)]
        for sighting, delta in zip(picture.sightings, seen, strict=True):
            if not len(sighting.vector):
                assert delta.similarity_q40 is None
            elif delta.object >= count:
                assert delta.similarity_q40 == Q40
            else:
                assert (delta.similarity_q40 is not None) == (delta.object in before)


@settings(max_examples=examples(10), deadline=None)
@given(_SEEDS)
def test_the_evidence_of_a_merge_is_that_of_each_pair_alone(seed: int) -> None:
    objects = EvidenceObjects(EvidenceConstants())
    for picture in pictures_of(a_room(seed, 10), seed, 40, bare=0.8):
        fold_one(objects, picture)
    things = [thing for thing in objects._index._things if thing is not None]
    merging, counts = objects._merging, objects._labels._counts
    for one in things:
        together = merging._looks(one, things)
        assert together == [merging._looks(one, [other])[0] for other in things]
        for other, value in zip(things, together, strict=True):
            if one.marks and other.marks:
                continue
            agree = other.class_name in one.classes or one.class_name in other.classes
            labels = sum(n * _label_ratio(one, name, counts) for name, n in other.classes.items())
            plain = (1.0 if agree else -1.0) + 0.5 * labels / other.count
            assert value == pytest.approx(plain, abs=1e-3)


@settings(max_examples=examples(10), deadline=None)
@given(_SEEDS)
def test_without_looks_nothing_is_said_of_looks(seed: int) -> None:
    objects = EvidenceObjects(EvidenceConstants())
    for picture in pictures_of(a_room(seed, 8), seed, 40, bare=1.0):
        fold_one(objects, picture)
    alive = [ObjectOrdinal(n) for n, thing in enumerate(objects._index._things) if thing]
    for one in alive[:4]:
        assert objects.compare(one, alive) == [None] * len(alive)
    assert objects.dump()["things.looks"].size == 0
    assert objects._scale.different() == _FIRST_GUESS


def test_a_thing_seen_by_a_bare_detector_is_recognised_by_its_look_later() -> None:
    """A map that began without embeddings uses them as soon as there are some."""
    room = a_room(3, 8)
    pictures = pictures_of(room, 3, 120)
    late = [
        picture
        if number >= 60
        else picture._replace(
            sightings=[s._replace(vector=NO_VECTOR, norm2=0) for s in picture.sightings]
        )
        for number, picture in enumerate(pictures)
    ]
    seen = [delta for delta in fold_all(late) if isinstance(delta, ObjectSeen)]
    compared = [delta for delta in seen if delta.similarity_q40 is not None]
    assert len(compared) > 0.8 * sum(len(picture.sightings) for picture in pictures[60:])
    merged = [delta for delta in fold_all(late) if isinstance(delta, ObjectsMerged)]
    assert len({d.object for d in seen}) - len(merged) <= 2 * len(room)
