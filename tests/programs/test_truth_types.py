"""Scores of places' types in ``scripts/bench_truth --types``."""

from projections.localize.evaluate.truth import Truth, read_truth
from projections.map.view import MapView
from scripts.programs.bench.truth.place_types import TypedPlace, TypesRow, typed_places, types_table
from tests.support.envelopes import detection, envelope
from tests.support.folds import fold


def three_rooms() -> MapView:
    """Four poses in each of three rooms: one with a toilet and a sink, two with nothing."""
    seen = [detection("toilet", [1, 0]), detection("sink", [0, 1])]
    return fold(
        envelope(10 * room + k, 20.0 * room + 0.1 * k, 0.0, detections=seen if room == 0 else [])
        for room in range(3)
        for k in range(4)
    ).view


def truth_of(rooms: list[str | None], tmp_path: object) -> Truth:
    import json
    from pathlib import Path

    path = Path(str(tmp_path)) / "truth.jsonl"
    lines = [
        json.dumps(
            {
                "run_id": "run-a",
                "keyframe_id": 10 * r + k,
                "room": name,
                "instances": [None] * (2 if r == 0 else 0),
            }
        )
        for r, name in enumerate(rooms)
        for k in range(4)
    ]
    path.write_text("\n".join(lines) + "\n")
    return read_truth([path])


def test_a_place_is_scored_against_what_its_room_is_called(tmp_path: object) -> None:
    view = three_rooms()
    bath, *others = typed_places(view, truth_of(["toilets", "balcony", "west office"], tmp_path))
    assert (bath.true, bath.said, bath.likeliest, bath.keyframes) == (
        "bathroom",
        "bathroom",
        "bathroom",
        4,
    )
    assert others == [
        TypedPlace(None, None, None, 0.0, 4),
        TypedPlace("office", None, None, 0.0, 4),
    ]


def test_the_table_counts_right_wrong_and_unsure() -> None:
    places = (
        TypedPlace("kitchen", "kitchen", "kitchen", 0.95, 30),
        TypedPlace("kitchen", "office", "office", 0.6, 10),
        TypedPlace("office", None, "office", 0.4, 10),
        TypedPlace("hall", None, None, 0.0, 10),
        TypedPlace(None, None, "hall", 0.3, 10),
    )
    table = types_table([TypesRow("robot house page", places)]).splitlines()
    assert table[1].split() == [
        *("robot", "house", "page", "4", "0.25", "0.25", "0.50", "0.50", "0.50", "0.50", "0.50"),
        *("1", "1.00"),
    ]
    assert "  said with 0.9 or more: 1, right 1.00" in table
    assert "  said with 0.5 or more: 1, right 0.00" in table
