"""The scores of ``scripts/bench_truth --places`` on cases small enough to score by hand."""

import dataclasses

import pytest

from projections.fold.deltas import (
    KeyframeOrdinal,
    KeyframePlaced,
    PlaceFormed,
    PlaceLink,
    PlaceOrdinal,
    PlacesMerged,
)
from projections.localize.evaluate.truth import Truth
from projections.map.view import MapView
from scripts.programs.bench.truth.places import PlaceScores, PlacesRow, places_table, score_places
from tests.programs.truth_cases import hand_made

_SCORES = PlaceScores(0.8, 1.0, 0.7, 0.02, 0.1, 0.05, 1.5, 2.0)


def _case(rooms: list[str | None], places: list[int | None]) -> tuple[MapView, Truth]:
    founded = [
        PlaceFormed(0, PlaceOrdinal(p), f"a_p{p}", KeyframeOrdinal(places.index(p)))
        for p in sorted({p for p in places if p is not None})
    ]
    placed = [
        KeyframePlaced(0, KeyframeOrdinal(k), PlaceOrdinal(p))
        for k, p in enumerate(places)
        if p is not None
    ]
    view, truth = hand_made([("a", k, 0, None, 0) for k in range(len(rooms))], [*founded, *placed])
    for key, room in zip(list(truth.keyframes), rooms, strict=True):
        truth.keyframes[key] = truth.keyframes[key].model_copy(update={"room": room})
    return view, truth


def test_noise_is_a_cluster_of_its_own():
    view, truth = _case(["A", "A", "B", "B", None], [0, 0, None, None, 0])
    scores = score_places(view, truth, {}, 0, 1.0)
    assert (scores.v_measure, scores.noise, scores.ratio) == (1.0, 0.4, 0.5)


def test_keyframes_are_renamed_that_end_in_another_place_than_their_first():
    view, truth = _case(["A"] * 4, [0, 0, 1, 1])
    link = PlaceLink(KeyframeOrdinal(0), KeyframeOrdinal(2), 0)
    merged = PlacesMerged(9, PlaceOrdinal(0), (PlaceOrdinal(1),), link.core, (link,), 2, (2,))
    view.apply_event(9, [merged])
    first = {KeyframeOrdinal(k): PlaceOrdinal(p) for k, p in enumerate([0, 0, 1, 0])}
    scores = score_places(view, truth, first, 1, 1.0)
    assert (scores.renamed, scores.late, scores.ratio) == (0.25, 0.25, 1.0)


def test_half_of_each_room_in_one_place_has_the_v_measure_computed_by_hand():
    # Rooms A, A, B, B in places 0, 0, 0, 1: mutual information 0.2158 nats of ln 2 and 0.5623.
    view, truth = _case(["A", "A", "B", "B"], [0, 0, 0, 1])
    scores = score_places(view, truth, {}, 0, 1.0)
    assert scores.homogeneity == pytest.approx(0.3113, abs=1e-4)
    assert scores.completeness == pytest.approx(0.3837, abs=1e-4)
    assert scores.v_measure == pytest.approx(0.3437, abs=1e-4)


def test_the_table_names_the_worst_building_of_each_rule_and_means_without_the_house():
    better, worse = (dataclasses.replace(_SCORES, v_measure=v) for v in (0.9, 0.6))
    rows = [
        PlacesRow("mast one", 10, 3, {"page": worse, "rooms": better}),
        PlacesRow("fog two", 20, 4, {"page": better, "rooms": worse}),
        PlacesRow("house-a", 5, 2, {"page": worse, "rooms": _SCORES}),
    ]
    lines = places_table(rows).splitlines()
    assert [line.split()[0] for line in lines[1:4]] == ["mast", "house-a", "fog"]
    mean = next(line for line in lines if line.startswith("mean")).split()
    assert mean[1:5] == ["30", "7", "0.750", "0.750"]
    assert mean[-2:] == ["4.00", "1.00"]
    assert lines[-2:] == ["worst page: mast one 0.600", "worst rooms: fog two 0.600"]
