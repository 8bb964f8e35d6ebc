"""The fold, its deltas and its view together equal a naive implementation."""

import random
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from projections.fold.settings import Settings
from projections.map.digest import map_digest
from tests.support.envelopes import detection, envelope
from tests.support.folds import Folded, resumed
from tests.support.naive_map import NaiveMap

LOOKS = [[1, 0, 0], [1, 1, 0], [3, 4, 0], [0, 1, 2], [-1, 0.3, 1e-3], [1e-30, 2e-30, 0]]
LOOKS += [[-1, 0, 0], [1, 2]]


@st.composite
def worlds(draw: st.DrawFn) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Settings, and keyframes of three runs whose numbers, det_ids and times conflict: repeats,
    det_ids used twice, late arrivals, keyframes without a pose, vectors of another space."""
    rng = random.Random(draw(st.integers(0, 2**32)))
    settings = {
        "eps_m": rng.choice([0.5, 0.75, 1.0]),
        "min_samples": rng.choice([1, 2, 3, 3, 4, 6]),
        "fusion_radius_m": rng.choice([0.25, 1.0, 3.0]),
        "fusion_similarity": rng.choice([-1.0, 0.0, 0.7, 0.98, 1.0]),
        "embedding_dim": rng.choice([None, None, 2, 3]),
    }
    count = draw(st.integers(0, 30))
    documents: list[dict[str, Any]] = []
    for _ in range(count):
        if documents and rng.random() < 0.1:
            documents.append({**rng.choice(documents), **rng.choice([{}, {"timestamp": 3.5}])})
        else:
            documents.append(_document(rng))
    return settings, documents


def _document(rng: random.Random) -> dict[str, Any]:
    run, number = rng.choice("aabc"), rng.randrange(-5, 25)
    detections = []
    for index in range(rng.choice([0, 0, 1, 2, 3])):
        det_id = f"{run}{number}-{index}" if rng.random() < 0.9 else f"shared-{index}"
        more: dict[str, Any] = {"det_id": det_id} if rng.random() < 0.7 else {}
        if rng.random() < 0.05:
            more["embedding_model"] = "another"
        look = rng.choice(LOOKS) if rng.random() < 0.9 else None
        detections.append(detection(rng.choice(["cup", "chair"]), look, **more))
    x = None if rng.random() < 0.1 else rng.randrange(0, 17) * 0.25 + rng.choice([0.0, 1e-7, 0.1])
    y, yaw = rng.randrange(0, 4) * 0.25, rng.choice([0.0, 1.0, 2.0])
    fields: dict[str, Any] = {"run_id": run, "timestamp": rng.choice([1.0, 2.5, 1e9])}
    if x is not None:
        fields["map_yaw"] = yaw
    return envelope(number, x, y, detections=detections, **fields)


@given(world=worlds())
def test_after_every_event_the_digest_is_that_of_the_naive_map(
    world: tuple[dict[str, Any], list[dict[str, Any]]],
) -> None:
    settings, documents = world
    check_every_prefix(Folded.start(Settings(**settings)), NaiveMap(settings), documents)


@given(
    world=worlds(),
    cell_m=st.sampled_from([0.2, 0.25, 0.6]),
    drive_m=st.sampled_from([0.5, 1.0, 2.0]),
)
def test_the_digest_is_that_of_the_naive_map_of_places_by_rooms(
    world: tuple[dict[str, Any], list[dict[str, Any]]], cell_m: float, drive_m: float
) -> None:
    settings, documents = world
    settings |= {"places": "rooms", "rooms": {"cell_m": cell_m, "drive_m": drive_m}}
    check_every_prefix(Folded.start(Settings(**settings)), NaiveMap(settings), documents)


@given(world=worlds())
def test_the_digest_is_that_of_the_naive_map_when_every_event_is_folded_by_a_restored_map(
    world: tuple[dict[str, Any], list[dict[str, Any]]],
) -> None:
    raw, documents = world
    settings, naive = Settings(**raw), NaiveMap(raw)
    folded = Folded.start(settings)
    for document in documents:
        folded.extend([document])
        naive.fold(document)
        assert map_digest(folded.view) == naive.digest()
        folded = resumed(folded)
    assert folded.view.skipped == {kind: naive.left_out[kind] for kind in folded.view.skipped}


def check_every_prefix(folded: Folded, naive: NaiveMap, documents: list[dict[str, Any]]) -> None:
    for document in documents:
        folded.extend([document])
        naive.fold(document)
        assert map_digest(folded.view) == naive.digest()
    assert folded.view.skipped == {
        kind: naive.left_out[kind] for kind in ("duplicate", "conflict", "det_id_reused")
    }
