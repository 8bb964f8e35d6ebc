"""Things that are carried elsewhere, or away, between two runs, in the whole fold by evidence."""

import math
from typing import Any

import numpy as np
import pytest

from projections.fold.deltas import ObjectMissing, ObjectRelocated, ObjectsMerged
from projections.fold.settings import Settings
from projections.map.digest import map_digest
from projections.map.records import ObjectRecord
from tests.support.envelopes import detection, envelope
from tests.support.folds import Folded, resumed
from tests.support.thorough import mostly_slow

SETTINGS = Settings(fusion="evidence")
FOCAL = 320 / math.tan(math.radians(69.4 / 2))
CHANCE = np.random.default_rng(5)
LOOK = {name: CHANCE.normal(size=32) + 1.0 for name in ("chair", "table", "plant", "tv", "bed")}
ROOM = {"chair": (1.0, 2.0), "table": (2.2, 2.2), "plant": (4.0, 2.0), "tv": (6.0, 2.3)}


def run(name: str, room: dict[str, tuple[float, float]], passes: int = 3) -> list[dict[str, Any]]:
    """The robot drives along the x axis and looks to its left, some degrees to either side."""
    chance = np.random.default_rng(len(name))
    documents = []
    poses = [
        (0.5 * step + 0.05 * number, yaw)
        for number in range(passes)
        for step in range(16)
        for yaw in (1.2, 1.9)
    ]
    for number, (x, yaw) in enumerate(poses):
        seen = []
        for thing, (tx, ty) in room.items():
            ahead = (tx - x) * math.cos(yaw) + ty * math.sin(yaw)
            aside = ty * math.cos(yaw) - (tx - x) * math.sin(yaw)
            if 0.5 < ahead < 3.0 and abs(aside) < 0.6 * ahead:
                u, half = 320 - FOCAL * aside / ahead, FOCAL * 0.2 / ahead
                box = [max(u - half, 0.0), 200 - half, min(u + half, 640.0), 200 + half]
                vector = LOOK[thing] + 0.2 * chance.normal(size=32)
                seen.append(detection(thing, vector, bbox=box))
        documents.append(envelope(number, x, 0.0, map_yaw=yaw, run_id=name, detections=seen))
    return documents


def of_class(folded: Folded, name: str) -> list[ObjectRecord]:
    return [found for found in folded.view.objects.values() if found.class_name == name]


def at(found: ObjectRecord) -> tuple[float, float]:
    assert found.estimate is not None
    return found.estimate.est_x, found.estimate.est_y


def told(folded: Folded, kind: type) -> list[Any]:
    return [delta for deltas in folded.deltas for delta in deltas if isinstance(delta, kind)]


def test_a_chair_that_is_carried_elsewhere_is_moved_neither_new_nor_averaged():
    folded = Folded.start(SETTINGS).extend(run("a", ROOM))
    assert len(folded.view.objects) == 4
    (before,) = of_class(folded, "chair")
    assert math.dist(at(before), (1.0, 2.0)) < 0.3
    seen_before = before.obs_count
    folded.extend(run("b", ROOM | {"chair": (7.0, 2.0)}))
    (chair,) = of_class(folded, "chair")
    assert chair.ordinal == before.ordinal
    assert math.dist(at(chair), (7.0, 2.0)) < 0.3
    assert chair.obs_count > seen_before
    assert chair.missing_in is None
    (moved,) = chair.relocations
    assert math.dist((moved.from_x_um / 1e6, moved.from_y_um / 1e6), (1.0, 2.0)) < 0.3
    assert math.dist((moved.to_x_um / 1e6, moved.to_y_um / 1e6), (7.0, 2.0)) < 0.3
    observation = folded.view.observations[moved.observation]
    assert folded.view.keyframes[observation.keyframe].run_id == "b"
    (merged,) = told(folded, ObjectsMerged)
    assert merged.evidence is not None
    assert merged.evidence.distance_um == pytest.approx(6e6, abs=5e5)
    assert len(folded.view.objects) == 4
    others = [found for found in folded.view.objects.values() if found is not chair]
    assert not any(found.relocations or found.missing_in is not None for found in others)


def test_a_chair_that_is_carried_away_is_missing_until_it_is_back():
    folded = Folded.start(SETTINGS).extend(run("a", ROOM))
    without = {name: there for name, there in ROOM.items() if name != "chair"}
    folded.extend(run("b", without))
    (chair,) = of_class(folded, "chair")
    assert folded.view.runs[chair.missing_in].run_id == "b"
    assert chair.misses >= 2
    assert [found.class_name for found in folded.view.objects.values() if found.missing_in] == [
        "chair"
    ]
    folded.extend(run("c", ROOM))
    (again,) = of_class(folded, "chair")
    assert again is chair
    assert again.missing_in is None
    assert again.relocations == []
    assert [delta.missing for delta in told(folded, ObjectMissing)] == [True, False]


def test_a_new_thing_that_looks_otherwise_is_no_moved_one():
    folded = Folded.start(SETTINGS).extend(run("a", ROOM))
    room = {name: there for name, there in ROOM.items() if name != "chair"} | {"bed": (7.0, 2.0)}
    folded.extend(run("b", room))
    assert told(folded, ObjectRelocated) == []
    assert len(of_class(folded, "bed")) == 1
    assert of_class(folded, "chair")[0].missing_in is not None


def test_a_second_chair_beside_the_first_is_no_moved_one(monkeypatch):
    """Both are seen in run b, so they are two, however alike."""
    monkeypatch.setitem(LOOK, "twin", LOOK["chair"])
    folded = Folded.start(SETTINGS).extend(run("a", ROOM))
    documents = run("b", ROOM | {"twin": (7.0, 2.0)})
    for document in documents:
        for seen in document["detections"]:
            seen["class"] = seen["class"].replace("twin", "chair")
    folded.extend(documents)
    assert told(folded, ObjectRelocated) == []
    assert len(of_class(folded, "chair")) == 2


def test_no_object_is_missing_where_none_was_carried_away():
    folded = Folded.start(SETTINGS)
    for name in ("a", "b", "c"):
        folded.extend(run(name, ROOM))
    assert told(folded, ObjectMissing) == []
    assert told(folded, ObjectRelocated) == []
    assert len(folded.view.objects) == 4


@pytest.mark.parametrize("cut", mostly_slow([96, 185, 120, 150], 2))
@pytest.mark.seconds
def test_a_fold_goes_on_from_a_kept_state_between(cut):
    documents = run("a", ROOM) + run("b", ROOM | {"chair": (7.0, 2.0)})
    whole = Folded.start(SETTINGS).extend(documents)
    begun = Folded.start(SETTINGS).extend(documents[:cut])
    again = resumed(begun)
    again.extend(documents[cut:])
    assert map_digest(again.view) == map_digest(whole.view)
    assert told(whole, ObjectRelocated) == told(begun, ObjectRelocated) + told(
        again, ObjectRelocated
    )
