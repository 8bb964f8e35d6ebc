"""Two floors share no place and no Object, and all else is as it is on one floor."""

import random
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from projections.fold.corrections import Corrections, Keyframe
from projections.fold.deltas import PlacesMerged
from projections.fold.settings import Settings
from projections.map.digest import map_digest
from projections.map.view import MapView
from tests.property.test_whole_fold import worlds
from tests.support.envelopes import detection, envelope
from tests.support.evidence_drives import drives, recounted_votes
from tests.support.folds import (
    Folded,
    fold,
    near_matrix,
    recounted_adjacency,
    recounted_places,
    resumed,
)
from tests.support.memory_history import MemoryHistory
from tests.support.naive_map import NaiveMap, micrometres

FLOORS: list[dict[str, Any]] = [
    {},
    {"floor": "0"},
    {"floor": 1},
    {"floor": "1"},
    {"floor": "attic"},
]
FLOORS += [{"map_z": 0.4}, {"map_z": 1.6}, {"map_z": 1.5, "floor": "0"}, {"map_z": -40.0}]


def name_of(document: dict[str, Any]) -> str | None:
    """The floor of an envelope at three metres a floor, by counting down from the top."""
    if document.get("floor") is not None:
        return str(document["floor"])
    if document.get("map_z") is None:
        return None
    floor = 50
    while micrometres(document["map_z"]) < floor * 3_000_000 - 1_500_000:
        floor -= 1
    return str(floor)


class NaiveFloors(NaiveMap):
    """`NaiveMap`, in which nothing on another floor is near."""

    def fold(self, document: dict[str, Any]) -> None:
        self.coming = name_of(document)
        count = len(self.keyframes)
        super().fold(document)
        if len(self.keyframes) > count and document.get("map_x") is None:
            self.keyframes[-1]["floor"] = None

    def _cluster(self, pose: tuple[int, int] | None) -> None:
        self.keyframes[-1]["floor"] = self.coming
        if pose is None:
            return
        posed = [k for k in self.keyframes if k["pose"] is not None]
        points = [(*k["pose"], k["yaw"]) for k in posed]
        self.places.add(
            near_matrix(
                len(points),
                lambda i, j: (
                    posed[i]["floor"] == posed[j]["floor"]
                    and self.is_within_eps(points[i], points[j])
                ),
            )
        )

    def _fuse(self, observation: dict[str, Any]) -> None:
        every, here = self.objects, self.coming
        self.objects = [
            members if members[0]["keyframe"]["floor"] == here else [elsewhere(members[0])]
            for members in every
        ]
        super()._fuse(observation)
        if len(self.objects) > len(every):
            every.append(self.objects[-1])
        self.objects = every

    def _more_sections(self, labels: list[int | None]) -> dict[str, list[Any]]:
        named = [(i, k["floor"]) for i, k in enumerate(self.keyframes) if k["floor"] is not None]
        return {"floors": named} if named else {}


def elsewhere(member: dict[str, Any]) -> dict[str, Any]:
    """A member of an Object that no observation can fuse with."""
    return {**member, "class": object()}


@st.composite
def buildings(draw: st.DrawFn) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """`worlds` on several floors."""
    settings, documents = draw(worlds())
    rng = random.Random(draw(st.integers(0, 2**32)))
    few = rng.sample(FLOORS, rng.randint(1, 4))
    return settings, [{**document, **rng.choice(few)} for document in documents]


@given(building=buildings())
def test_after_every_event_the_digest_is_that_of_the_naive_map_with_floors(
    building: tuple[dict[str, Any], list[dict[str, Any]]],
) -> None:
    settings, documents = building
    folded, naive = Folded.start(Settings(**settings)), NaiveFloors(settings)
    for document in documents:
        folded.extend([document])
        naive.fold(document)
        # A conflict counts the floor as content, which the naive map does not know of.
        if len(folded.view.keyframes) == len(naive.keyframes):
            assert map_digest(folded.view) == naive.digest()
    check_floors(folded)


@given(building=buildings())
def test_kept_folds_with_floors_go_on_as_the_fold_does(
    building: tuple[dict[str, Any], list[dict[str, Any]]],
) -> None:
    raw, documents = building
    settings = Settings(**raw)
    check_resumed(settings, documents)


@given(documents=drives(), seed=st.integers(0, 2**32), places=st.sampled_from(["page", "rooms"]))
@pytest.mark.slow
def test_fusion_by_evidence_and_rooms_keep_floors_apart_too(
    documents: list[dict[str, Any]], seed: int, places: Any
) -> None:
    rng = random.Random(seed)
    few = rng.sample(FLOORS, 3)
    documents = [{**document, **rng.choice(few)} for document in documents]
    settings = Settings(fusion="evidence", eps_m=1.0, places=places)
    folded = check_resumed(settings, documents)
    check_floors(folded)
    for found in folded.view.objects.values():
        estimate = found.estimate
        assert estimate is not None
        assert abs(estimate.x_um) < 10**8, "as far as a picture shows, on its own floor"


def check_resumed(settings: Settings, documents: list[dict[str, Any]]) -> Folded:
    """A fold that is stored and restored after each event is one that is not, which is returned."""
    whole, restored = Folded.start(settings), Folded.start(settings)
    for document in documents:
        whole.extend([document])
        restored.extend([document])
        assert map_digest(restored.view) == map_digest(whole.view)
        restored = resumed(restored)
        assert restored.view.floors == whole.view.floors
    return whole


def check_floors(folded: Folded) -> None:
    """No place and no Object is on two floors, and all sums are those of a recount."""
    view, deltas = folded.view, [delta for each in folded.deltas for delta in each]
    for place in view.places.values():
        assert {view.keyframes[k].floor for k in place.members} == {view.floor_of(place.ordinal)}
    for found in view.objects.values():
        seen = {view.keyframes[view.observations[o].keyframe].floor for o in found.observations}
        assert len(seen) == 1
        poses = [view.keyframes[view.observations[o].keyframe].pose for o in found.observations]
        assert found.sum_x_um == sum(pose.x_um for pose in poses if pose is not None)
    sums = {p.ordinal: (p.keyframe_count, p.sum_x_um, p.sum_y_um) for p in view.places.values()}
    assert sums == recounted_places(view)
    assert view.adjacency == recounted_adjacency(view)
    if not view.maps:  # else those of a region are in its place
        assert [o.place for o in view.objects.values()] == recounted_votes(view, deltas)


def drive(*floors: dict[str, Any]) -> list[dict[str, Any]]:
    """The same six poses on each floor, by one run, with a cup."""
    return [
        envelope(
            100 * number + k,
            0.5 * k,
            0.0,
            detections=[detection("cup", [1.0, 0.0], det_id=f"cup-{number}-{k}")],
            **floor,
        )
        for number, floor in enumerate(floors)
        for k in range(6)
    ]


def test_floors_one_above_the_other_are_two_places_with_a_way_between_them() -> None:
    view = fold(drive({"floor": 0}, {"floor": 1})).view
    assert [(p.place_id, p.centroid_x, p.centroid_y) for p in view.places.values()] == [
        ("run-a_p0", 1.25, 0.0),
        ("run-a_p1", 1.25, 0.0),
    ]
    assert view.edges() == [(0, 1, 1)]
    assert view.is_between_floors(0, 1)
    assert [view.floor_of(place) for place in view.places] == ["0", "1"]
    assert len(view.objects) == 2


@pytest.mark.parametrize(
    ("height", "z", "name"),
    [
        (3.0, 0.0, "0"),
        (3.0, 1.499999, "0"),
        (3.0, 1.5, "1"),
        (3.0, -1.5, "0"),
        (3.0, -1.500001, "-1"),
        (3.0, 5.9, "2"),
        (4.0, 5.9, "1"),
        (0.5, 1e7, "20000000"),
    ],
)
def test_a_height_tells_the_floor(height: float, z: float, name: str) -> None:
    view = fold(drive({"map_z": z}), floor_height_m=height).view
    assert list(view.floors) == [name]
    assert len(view.places) == 1


def test_a_map_of_one_floor_is_the_map_without_floors_but_for_its_name() -> None:
    plain, named = fold(drive({})), fold(drive({"floor": "ground"}))
    assert map_digest(plain.view) != map_digest(named.view)
    kinds = [[[type(d) for d in deltas] for deltas in each.deltas] for each in (plain, named)]
    assert kinds[0] == kinds[1]
    plain_last, named_last = plain.deltas[-1], named.deltas[-1]
    for before, after in zip(plain_last, named_last, strict=True):
        if getattr(after, "floor", None) is None and not hasattr(after, "embedding"):
            assert before == after


def test_a_join_and_a_same_object_across_floors_are_obeyed_on_the_first_floor_only() -> None:
    documents = drive({"floor": 0}, {"floor": 1})
    far = [
        {
            **d,
            "map_x": d["map_x"] + 50.0,
            "keyframe_id": d["keyframe_id"] + 50,
            "detections": [{**s, "det_id": "far-" + s["det_id"]} for s in d["detections"]],
        }
        for d in documents
    ]
    documents += far
    corrections = Corrections(
        joined=(
            (Keyframe("run-a", 0), Keyframe("run-a", 50)),
            (Keyframe("run-a", 0), Keyframe("run-a", 100)),
        ),
        same=(("cup-0-0", "far-cup-0-0"), ("cup-0-0", "cup-1-0")),
    )
    folded = Folded.start(corrections=corrections).extend(documents)
    view = folded.view
    check_floors(folded)
    assert [view.floor_of(p) for p in view.places] == ["0", "1", "1"]
    assert len(folded.all(PlacesMerged)) == 1
    by_det = {o.det_id: o.object for o in view.observations}
    assert by_det["cup-0-0"] == by_det["far-cup-0-0"] != by_det["cup-1-0"]
    assert map_digest(resumed_in_the_middle(corrections, documents)) == map_digest(view)


def resumed_in_the_middle(corrections: Corrections, documents: list[dict[str, Any]]) -> MapView:
    first = Folded.start(corrections=corrections).extend(documents[:9])
    return resumed(first).extend(documents[9:]).view


def test_neighbours_of_a_history_are_on_one_floor() -> None:
    folded = fold(drive({}, {"floor": 1}))
    history = MemoryHistory(Settings())
    for offset, deltas in enumerate(folded.deltas):
        history.apply(offset, deltas)
    near = history.neighbours
    assert near.of(7, 12) == [6, 7, 8, 9, 10]
    assert near.positions([7]).tolist() == [[0.5, 0.0]]
    assert near.distance_um(6, 9) == 1_500_000
