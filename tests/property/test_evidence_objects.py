"""Fusion by evidence on made-up rooms: rules that hold for any input."""

import json
from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from eventsrc.envelope.model import DetId, Offset
from projections.fold import State
from projections.fold.deltas import (
    ObjectClassified,
    ObjectEstimated,
    ObjectFound,
    ObjectOrdinal,
    ObjectSeen,
    ObjectsMerged,
    ObservationOrdinal,
    Pose,
    RunOrdinal,
)
from projections.fold.evidence import EvidenceConstants
from projections.fold.evidence_objects import EvidenceObjects, ObjectDelta
from projections.fold.pair_groups import ApartPairs, PairGroups
from projections.fold.thing_index import ThingIndex
from tests.support.evidence_pictures import (
    DIM,
    Picture,
    a_room,
    a_sighting,
    fold_all,
    fold_one,
    pictures_of,
)
from tests.support.thorough import examples

_SEEDS = st.integers(0, 10_000)
_BARE = st.sampled_from([0.0, 0.5, 1.0])
"""Share of sightings without an embedding."""


def _assignment(deltas: list[ObjectDelta]) -> dict[ObservationOrdinal, ObjectOrdinal]:
    """The Object of each observation after all deltas."""
    of: dict[ObservationOrdinal, ObjectOrdinal] = {}
    for delta in deltas:
        if isinstance(delta, ObjectSeen):
            of[delta.observation] = delta.object
        elif isinstance(delta, ObjectsMerged):
            for observation, ordinal in of.items():
                if ordinal == delta.absorbed:
                    of[observation] = delta.survivor
    return of


def _through_json(state: State) -> State:
    """As it is kept: arrays as they are, the rest as JSON."""
    return {
        key: value if isinstance(value, np.ndarray) else json.loads(json.dumps(value))
        for key, value in state.items()
    }


@settings(max_examples=examples(15), deadline=None)
@given(_SEEDS, st.integers(0, 40), _BARE)
def test_a_dump_taken_anywhere_goes_on_as_if_nothing_had_happened(
    seed: int, cut: int, bare: float
) -> None:
    pictures = pictures_of(a_room(seed), seed, 40, bare=bare)
    objects = EvidenceObjects(EvidenceConstants())
    before = [delta for picture in pictures[:cut] for delta in fold_one(objects, picture)]
    other = EvidenceObjects(EvidenceConstants())
    other.load(_through_json(objects.dump()))
    after = [delta for picture in pictures[cut:] for delta in fold_one(other, picture)]
    assert before + after == fold_all(pictures)


@settings(max_examples=examples(15), deadline=None)
@given(_SEEDS, _BARE)
def test_two_things_in_one_picture_are_never_one(seed: int, bare: float) -> None:
    pictures = pictures_of(a_room(seed, 12), seed, 40, bare=bare)
    objects = EvidenceObjects(EvidenceConstants())
    for picture in pictures:
        seen = [d.object for d in fold_one(objects, picture) if isinstance(d, ObjectSeen)]
        assert len(set(seen)) == len(seen) == len(picture.sightings)


@settings(max_examples=examples(15), deadline=None)
@given(_SEEDS, _BARE)
def test_deltas_are_complete_and_in_order(seed: int, bare: float) -> None:
    pictures = pictures_of(a_room(seed, 12), seed, 60, bare=bare)
    objects = EvidenceObjects(EvidenceConstants())
    alive: set[ObjectOrdinal] = set()
    members: Counter[ObjectOrdinal] = Counter()
    labels: dict[ObjectOrdinal, list[str]] = {}
    classes: dict[ObjectOrdinal, str] = {}
    for picture in pictures:
        deltas = fold_one(objects, picture)
        kinds = [type(delta).__name__ for delta in deltas]
        order = ["ObjectsMerged", "ObjectClassified", "ObjectEstimated"]
        later = [order.index(kind) for kind in kinds if kind in order]
        assert later == sorted(later)
        assert [d.observation for d in deltas if isinstance(d, ObjectSeen)] == [
            sighting.observation for sighting in picture.sightings
        ]
        label_of = {s.observation: s.class_name for s in picture.sightings}
        changed: set[ObjectOrdinal] = set()
        for delta in deltas:
            if isinstance(delta, ObjectFound):
                assert delta.object == len(classes)
                alive.add(delta.object)
                classes[delta.object] = delta.class_name
                labels[delta.object] = []
            elif isinstance(delta, ObjectSeen):
                members[delta.object] += 1
                assert delta.obs_count == members[delta.object]
                labels[delta.object].append(label_of[delta.observation])
                changed.add(delta.object)
            elif isinstance(delta, ObjectsMerged):
                assert delta.survivor < delta.absorbed
                assert delta.evidence is not None
                alive.remove(delta.absorbed)
                members[delta.survivor] += members.pop(delta.absorbed)
                assert delta.obs_count == members[delta.survivor]
                labels[delta.survivor] += labels.pop(delta.absorbed)
                changed.add(delta.survivor)
                changed.discard(delta.absorbed)
            elif isinstance(delta, ObjectClassified):
                assert classes[delta.object] != delta.class_name
                classes[delta.object] = delta.class_name
        estimated = [delta for delta in deltas if isinstance(delta, ObjectEstimated)]
        assert [delta.object for delta in estimated] == sorted(changed)
        for delta in estimated:
            assert delta.object in alive
            assert delta.var_xx_um2 * delta.var_yy_um2 > delta.var_xy_um2**2
        for ordinal in alive:
            counts = Counter(labels[ordinal])
            assert counts[classes[ordinal]] == max(counts.values())


@settings(max_examples=examples(10), deadline=None)
@given(_SEEDS, st.data(), _BARE)
def test_commands_are_obeyed(seed: int, data: st.DataObject, bare: float) -> None:
    pictures = pictures_of(a_room(seed, 6), seed, 40, bare=bare)
    det_ids = [s.det_id for picture in pictures for s in picture.sightings]
    number = {det_id: index for index, det_id in enumerate(det_ids)}
    if len(det_ids) < 4:
        return
    named = st.sampled_from(det_ids)
    same = data.draw(st.lists(st.tuples(named, named), max_size=4))
    same_groups = PairGroups[DetId](same, ApartPairs())
    apart = [
        (a, b)
        for a, b in data.draw(st.lists(st.tuples(named, named), max_size=4))
        if a != b
        and (
            a not in same_groups.group_of or same_groups.group_of[a] != same_groups.group_of.get(b)
        )
    ]
    of = _assignment(fold_all(pictures, PairGroups(same, ApartPairs.of(apart))))
    for a, b in same:
        assert of[ObservationOrdinal(number[a])] == of[ObservationOrdinal(number[b])]
    for a, b in apart:
        assert of[ObservationOrdinal(number[a])] != of[ObservationOrdinal(number[b])]


@pytest.mark.parametrize("bare", [0.0, 0.5, 1.0])
def test_it_finds_the_things_of_a_room_where_they_stand(bare: float) -> None:
    room = a_room(3, 8)
    pictures = pictures_of(room, 3, 120, bare=bare)
    deltas = fold_all(pictures)
    truth = _truth(pictures)
    of = _assignment(deltas)
    pairs = Counter((truth[observation], ordinal) for observation, ordinal in of.items())
    wrong = sum(pairs.values()) - sum(
        max(n for (thing, _), n in pairs.items() if thing == one) for one in set(truth.values())
    )
    assert wrong <= 0.03 * len(of)
    last = {d.object: d for d in deltas if isinstance(d, ObjectEstimated)}
    for (thing, ordinal), count in pairs.items():
        if count >= 10:
            where = last[ordinal]
            assert abs(where.x_um / 1e6 - room[thing].x) < 0.15
            assert abs(where.y_um / 1e6 - room[thing].y) < 0.15


def _truth(pictures: list[Picture]) -> dict[ObservationOrdinal, int]:
    return {
        sighting.observation: thing
        for picture in pictures
        for sighting, thing in zip(picture.sightings, picture.things, strict=True)
    }


@settings(max_examples=examples(10), deadline=None)
@given(_SEEDS)
def test_the_grid_changes_nothing(seed: int) -> None:
    """The naive search goes through all Objects and keeps those within reach."""

    class Naive(ThingIndex):
        def near(self, x: float, y: float) -> NDArray[np.int64]:
            found = []
            for ordinal, thing in enumerate(self._things):
                if thing is not None and thing.estimate is not None:
                    dx, dy = thing.estimate.x - x, thing.estimate.y - y
                    if dx * dx + dy * dy <= self._reach_m * self._reach_m:
                        found.append(ordinal)
            return np.array(found, np.int64)

    pictures = pictures_of(a_room(seed, 30, 30.0), seed, 60, side=30.0)
    constants = EvidenceConstants(range_m=2.0)
    objects, naive = EvidenceObjects(constants), EvidenceObjects(constants)
    index = Naive(constants)
    naive._index = naive._merging._index = naive._matching._index = index
    for picture in pictures:
        assert fold_one(objects, picture) == fold_one(naive, picture)


_PIXEL = st.one_of(
    st.floats(-1e300, 1e300), st.sampled_from([0.0, 5e-324, -5e-324, 320.0, 640.0, 400.0])
)


@settings(max_examples=examples(40), deadline=None)
@given(st.lists(st.tuples(_PIXEL, _PIXEL, _PIXEL, _PIXEL), min_size=1, max_size=12), _SEEDS)
def test_boxes_of_any_size_give_finite_estimates(
    boxes: list[tuple[float, float, float, float]], seed: int
) -> None:
    chance = np.random.default_rng(seed)
    objects = EvidenceObjects(EvidenceConstants())
    for number, box in enumerate(boxes):
        sighting = a_sighting(number, "chair", chance.normal(size=DIM), box)
        if number % 3 == 1:
            sighting = sighting._replace(depth=(1e6, 1e-300))
        if number % 3 == 2:
            sighting = sighting._replace(position=(-9e6, 9e6, 1e-300))
        x_um = int(chance.choice([0, 10**13, -(10**13)]))
        pose = Pose(x_um, 0, float(chance.uniform(-4, 4)))
        picture = Picture(Offset(number + 1), RunOrdinal(0), 0.0, pose, [sighting], [0])
        for delta in fold_one(objects, picture):
            if isinstance(delta, ObjectEstimated):
                assert abs(delta.x_um) < 10**14
                assert delta.var_xx_um2 > 0
                assert delta.var_yy_um2 > 0
    assert np.isfinite(objects.dump()["things.estimates"]).all()
