"""The fold: duplicates, conflicts, missing poses, foreign vectors, fusion; and its purity."""

import builtins
import copy
import datetime
import os
import random
import secrets
import socket
import time
import uuid
from typing import Any, NoReturn

import numpy as np
import pytest

from projections.fold import objects
from projections.fold.deltas import (
    EventSkipped,
    KeyframeAdded,
    ObjectFound,
    ObservationAdded,
    RunSeen,
)
from projections.fold.folded_ids import content_digest
from projections.fold.objects import object_id
from projections.fold.semantic_map import SemanticMap
from projections.fold.settings import Settings
from projections.map.digest import map_digest
from tests.support.envelopes import detection, envelope
from tests.support.folds import Folded, accepted, fold


def test_the_same_content_again_is_a_duplicate_however_it_is_written() -> None:
    first = envelope(7, 1.0, 2.0, detections=[detection(vector=[1, 2], det_id="run-a_kf7_d0")])
    again = {**dict(reversed(first.items())), "note": "unknown fields do not count"}
    again["detections"] = [detection(vector=[1, 2])]  # its id by default is the one written out
    folded = fold([first, envelope(8), again])
    assert folded.deltas[2] == [EventSkipped(2, "duplicate", "run-a", 7, None, 0)]
    assert folded.view.counts()["duplicates"] == 1
    assert folded.view.counts()["keyframes"] == 2


@pytest.mark.parametrize(
    "change",
    [
        {"timestamp": 1.0},
        {"map_x": 1.000001},
        {"map_yaw": 0.1},
        {"detections": []},
        {"detections": [detection("mug", [1, 2])]},
        {"detections": [detection(vector=[1, 2.001])]},
        {"detections": [detection(vector=[1, 2], confidence=0.1)]},
        {"detections": [detection(vector=[1, 2], embedding_model="other")]},
        {"detections": [detection()]},
    ],
)
def test_other_content_under_the_same_number_is_a_conflict_and_the_first_stands(
    change: dict[str, Any],
) -> None:
    first = envelope(7, 1.0, 2.0, detections=[detection(vector=[1, 2])])
    folded = fold([first, {**first, **change}])
    assert folded.deltas[1] == [EventSkipped(1, "conflict", "run-a", 7, None, 0)]
    assert map_digest(folded.view) == map_digest(fold([first]).view)


def test_the_digest_of_a_content_is_the_same_in_every_process_and_python() -> None:
    """It is kept beside logs. The same in CPython 3.10 to 3.13."""
    seen = [detection("cup", [1, 2], det_id="x"), detection("é")]
    digest = content_digest(accepted(envelope(7, 1.0, 2.0, detections=seen)))
    assert digest.hex() == "bc7dbc8e3a8bb14f42cb6364f81a2b2d"


def test_a_det_id_of_an_earlier_keyframe_is_left_out_and_the_rest_folded() -> None:
    folded = fold(
        [
            envelope(1, 0.0, 0.0, detections=[detection(vector=[1, 0], det_id="x")]),
            envelope(
                2,
                0.0,
                0.0,
                detections=[
                    detection(vector=[1, 0], det_id="x"),
                    detection(vector=[1, 0], det_id="y"),
                ],
            ),
        ]
    )
    assert EventSkipped(1, "det_id_reused", "run-a", 2, "x", 0) in folded.deltas[1]
    assert [o.det_id for o in folded.view.observations] == ["x", "y"]
    assert folded.view.objects[0].obs_count == 2
    assert folded.view.counts()["det_ids_reused"] == 1


def test_a_keyframe_without_a_pose_is_kept_but_neither_placed_nor_fused() -> None:
    lost = envelope(1, None, detections=[detection(vector=[1, 0])])
    view = fold([lost, *(envelope(i, 0.0, 0.0) for i in (2, 3, 4))]).view
    assert view.keyframes[0].pose is None
    assert view.keyframes[0].place is None
    assert view.observations[0].object is None
    assert view.observations[0].embedding is not None
    assert view.counts() | {"noise": 0, "poses": 3, "objects": 0} == view.counts()


def test_the_first_embedded_detection_decides_the_space_and_others_are_foreign() -> None:
    detections = [
        detection("a"),
        detection("a", [1, 0], det_id="two"),
        detection("a", [1, 0, 0], det_id="three"),
        detection("a", [1, 0], det_id="other", embedding_model="other"),
    ]
    view = fold([envelope(1, 0.0, 0.0, detections=detections)]).view
    assert [o.foreign_space for o in view.observations] == [False, False, True, True]
    assert [o.object for o in view.observations] == [None, 0, None, None]
    assert view.counts()["foreign_embeddings"] == 2
    assert view.observations[2].embedding is None


def test_settings_can_decide_the_space() -> None:
    detections = [detection("a", [1, 0], det_id="two"), detection("a", [1, 0, 0], det_id="three")]
    view = fold([envelope(1, 0.0, 0.0, detections=detections)], embedding_dim=3).view
    assert [o.foreign_space for o in view.observations] == [True, False]


def test_an_object_is_named_by_its_founding_observation() -> None:
    """The hash is SHA-256 of "x", worked out elsewhere."""
    assert object_id("x") == "obj-2d711642b726b044"
    folded = fold([envelope(1, 0.0, 0.0, detections=[detection(vector=[1, 0], det_id="x")])])
    assert folded.all(ObjectFound) == [ObjectFound(0, 0, "obj-2d711642b726b044", "cup", 0)]


def test_an_equal_match_goes_to_the_object_founded_first() -> None:
    """Two Objects mirror each other about the axis on which the third observation lies."""
    documents = [
        envelope(1, 0.0, 0.0, detections=[detection(vector=[1, 1], det_id="left")]),
        envelope(2, 9.0, 0.0, detections=[detection(vector=[-1, 1], det_id="right")]),
    ]
    middle = envelope(3, 4.5, 0.0, detections=[detection(vector=[0, 1], det_id="middle")])
    view = fold([*documents, middle], fusion_radius_m=5.0).view
    assert view.observations[2].object == 0
    view = fold([*documents[::-1], middle], fusion_radius_m=5.0).view
    assert view.objects[0].object_id == object_id("right")
    assert view.observations[2].object == 0


def test_fusion_is_inclusive_at_its_radius_and_exclusive_beyond() -> None:
    def objects(x: float) -> int:
        seen = [detection(vector=[1, 0], det_id=f"d{x}")]
        first = envelope(1, 0.0, 0.0, detections=[detection(vector=[1, 0])])
        return len(fold([first, envelope(2, x, 0.0, detections=seen)]).view.objects)

    assert objects(3.0) == 1
    assert objects(3.000001) == 2


@pytest.mark.seconds
def test_more_than_4096_observations_of_an_object_stay_exact() -> None:
    """Beyond 2¹² observations it takes two products; the cosine stays what it is."""
    folded = Folded.start(Settings())
    folded.extend(envelope(i, 0.0, 0.0, detections=[detection(vector=[3, 4])]) for i in range(4100))
    assert folded.view.objects[0].obs_count == 4100
    assert {o.similarity_q40 for o in folded.view.observations} == {2**40}
    thing = folded.map.objects.sums[0]
    assert thing.norm2 == sum(int(v) ** 2 for v in thing.vector_sum)


def test_opposite_vectors_leave_an_object_without_a_direction() -> None:
    """At −1 everything fuses; the third look meets a sum of zero, whose cosine is 0."""
    looks = [[3, 4], [-3, -4], [3, 4]]
    documents = [
        envelope(i, 0.0, 0.0, detections=[detection(vector=v)]) for i, v in enumerate(looks)
    ]
    view = fold(documents, fusion_similarity=-1.0).view
    assert [o.similarity_q40 for o in view.observations] == [2**40, -(2**40), 0]
    assert view.objects[0].obs_count == 3
    view = fold(documents[:2], fusion_similarity=-0.999999).view
    assert len(view.objects) == 2


def test_an_object_is_fused_up_to_the_bound_of_its_sums(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Five million observations of one chair; at the bound the error names the object."""
    folded = fold([envelope(0, 0.0, 0.0, detections=[detection(vector=[3, 4])])])
    chair = folded.map.objects.sums[0]
    times = 5_000_000
    chair.vector_sum *= times
    chair.norm2, chair.count = chair.norm2 * times**2, times
    folded.extend([envelope(1, 0.0, 0.0, detections=[detection(vector=[3, 4])])])
    assert folded.view.objects[0].obs_count == times + 1
    assert folded.view.observations[1].similarity_q40 == 2**40
    assert chair.norm2 == sum(int(v) ** 2 for v in chair.vector_sum)
    monkeypatch.setattr(objects, "MAX_IN_A_SUM", times + 1)
    before = chair.vector_sum.copy()
    with pytest.raises(OverflowError, match=r"object 0 of class 'cup' has 5000001 observations"):
        folded.extend([envelope(2, 0.0, 0.0, detections=[detection(vector=[3, 4])])])
    assert (chair.vector_sum == before).all()


def test_a_run_starts_with_its_earliest_keyframe_whenever_that_arrives() -> None:
    folded = fold([envelope(5), envelope(6), envelope(4)])
    assert folded.all(RunSeen) == [
        RunSeen(0, 0, "run-a", 1774357205.0),
        RunSeen(2, 0, "run-a", 1774357204.0),
    ]
    assert folded.view.runs[0].started_at == 1774357204.0
    assert folded.view.runs[0].keyframe_count == 3


def test_the_deltas_of_a_keyframe_come_in_the_order_of_the_contract() -> None:
    seen = [detection(vector=[1, 0])]
    folded = fold([envelope(i, 0.0, 0.0, detections=seen) for i in (1, 2, 3)])
    assert [type(d).__name__ for d in folded.deltas[2]] == [
        "KeyframeAdded",
        "ObservationAdded",
        "PlaceFormed",
        "KeyframePlaced",
        "KeyframePlaced",
        "KeyframePlaced",
        "PlaceChanged",
        "ObjectSeen",
        "ObjectMoved",
    ]


def test_skip_passes_over_an_offset_and_changes_nothing() -> None:
    semantic_map = SemanticMap(Settings())
    semantic_map.skip(0)
    deltas = semantic_map.fold(1, accepted(envelope(1)))
    assert semantic_map.next_offset == 2
    assert [d.offset for d in deltas if type(d) is KeyframeAdded] == [1]


def test_the_fold_uses_no_clock_chance_disk_or_network(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    documents = [
        envelope(i, i * 0.4, 0.0, detections=[detection(vector=[1, i], det_id=f"d{i}")])
        for i in range(40)
    ]
    doors = [accepted(document) for document in documents]
    expected = [len(deltas) for deltas in fold(documents).deltas]

    def refuse(*_: object, **__: object) -> NoReturn:
        raise AssertionError("the fold asked the world")

    class NoClock(datetime.datetime):
        now = utcnow = today = refuse  # type: ignore[assignment]

    for name in ("time", "time_ns", "monotonic", "monotonic_ns", "perf_counter", "sleep"):
        monkeypatch.setattr(time, name, refuse)
    for name in ("random", "randrange", "getrandbits", "shuffle", "choice", "seed", "randbytes"):
        monkeypatch.setattr(random, name, refuse)
    for name in ("rand", "random", "default_rng", "normal", "permutation"):
        monkeypatch.setattr(np.random, name, refuse)
    for module, name in (
        (os, "urandom"),
        (os, "open"),
        (os, "getenv"),
        (uuid, "uuid4"),
        (secrets, "token_bytes"),
        (socket, "socket"),
        (builtins, "open"),
    ):
        monkeypatch.setattr(module, name, refuse)
    monkeypatch.setattr(datetime, "datetime", NoClock)
    semantic_map = SemanticMap(Settings())
    counts = [len(semantic_map.fold(offset, door)) for offset, door in enumerate(doors)]
    monkeypatch.undo()
    assert counts == expected


def test_observations_carry_what_the_table_needs() -> None:
    folded = fold([envelope(3, 0.0, 0.0, detections=[detection(vector=[3, 4])])])
    (added,) = folded.all(ObservationAdded)
    assert (added.run_id, added.keyframe_id, added.det_id) == ("run-a", 3, "run-a_kf3_d0")
    assert added.bbox == (120.0, 80.0, 250.0, 310.0)
    assert (added.embedding / 2**20).round(6).tolist() == [0.6, 0.8]


@pytest.mark.parametrize(
    ("fields", "kind"),
    [
        ({}, "duplicate"),
        ({"depth_sigma_m": 0.5}, "conflict"),
        ({"depth_m": 2.5}, "conflict"),
        ({"position": [1.0, 2.0]}, "conflict"),
        ({"position_sigma_m": 0.5}, "duplicate"),
    ],
)
def test_a_depth_or_a_position_is_content_and_a_standard_error_of_none_is_not(
    fields: dict[str, Any], kind: str
) -> None:
    first = envelope(7, detections=[detection("cup", [1.0, 0.0], depth_m=2.0)])
    again = copy.deepcopy(first)
    again["detections"][0] |= fields
    assert [d.kind for d in fold([first, again]).deltas[1]] == [kind]
    stated = {**first, "camera": {"hfov_deg": 80.0, "width_px": 64.0, "height_px": 48.0}}
    assert [d.kind for d in fold([first, stated]).deltas[1]] == ["conflict"]
