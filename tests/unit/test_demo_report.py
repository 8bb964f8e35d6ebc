"""The demo's report: the numbers of each stage, and what did not agree."""

from copy import deepcopy
from typing import Any

import pytest

from projections.fold.settings import Settings
from projections.map.view import MapView
from projections.postgres.labels import LABELS, TABLE
from projections.surfaces.demo import story
from projections.surfaces.demo.story import most_telling, type_lines
from projections.surfaces.python import Map
from tests.support.envelopes import detection, envelope
from tests.support.folds import fold

RECORDED = {
    "run_id": "sim-1-a",
    "published": 10,
    "recorded": 10,
    "intact": True,
    "rejected": 0,
    "lost": 0,
    "drive_seconds": 61.0,
    "log_bytes": 2_000_000,
}
TAILED = {"events": 10, "batches": 4, "median_delay_s": 0.04, "worst_delay_s": 0.09}
HOUSE = Map(MapView(Settings()))
DIGEST, OTHER = HOUSE.digest, "0" * 64
REPLAYED = {
    "rows": dict.fromkeys([*LABELS, TABLE], 2),
    "same_rows_as_tail": True,
    "digest": DIGEST,
    "seconds": 0.2,
}


def _part(place: str, keyframes: int, room: str) -> dict[str, Any]:
    return {"place_id": f"sim-1-a_{place}", "keyframes": keyframes, "room": room}


def _merge(offset: int, one: str, other: str, smaller: int) -> dict[str, Any]:
    return {
        "offset": offset,
        "run_id": "sim-1-a",
        "keyframe_id": offset + 1,
        "bridge_room": "hall",
        "survivor": _part("p0", 30, one),
        "absorbed": [_part("p1", smaller, other)],
        "places_before": 5,
    }


CORRECTED = {
    "commands": [{"kind": "undo-merge", "offset": 1300}, {"kind": "name-place", "offset": 1301}],
    "named": _part("p12", 120, "dining room"),
    "apart": [_part("p11", 345, "living room"), _part("p12", 120, "dining room")],
    "places": 0,
    "digest": DIGEST,
    "replay_digest": DIGEST,
    "replay_seconds": 0.2,
}
NUMBERS = {
    "record": RECORDED,
    "replay": REPLAYED,
    "map": {"digest": DIGEST},
    "corrected": CORRECTED,
}


def test_a_merge_across_rooms_is_preferred_to_a_larger_one_within_a_room() -> None:
    within, across = _merge(3, "hall", "hall", 29), _merge(7, "hall", "study", 12)
    assert most_telling([within, across]) is across
    assert most_telling([within]) is within
    assert most_telling([]) is None


def test_no_merges() -> None:
    assert list(story.merge_lines([])) == ["no two places became one on this drive"]


def test_a_merge_is_reported_with_its_numbers() -> None:
    lines = "\n".join(story.merge_lines([_merge(7, "hall", "study", 12)]))
    for wanted in ("p0 (30 keyframes, hall)", "p1 (12 keyframes, study)", "event 7", "5 places"):
        assert wanted in lines
    assert "such moments" not in lines


def test_an_incomplete_log_is_reported() -> None:
    good = "\n".join(story.recording_lines(RECORDED, TAILED, 5, 8, 30.0))
    assert "byte for byte" in good
    assert "NOT" not in good
    torn = RECORDED | {"recorded": 9, "intact": False, "lost": 1}
    lines = "\n".join(story.recording_lines(torn, TAILED, 5, 8, 30.0))
    assert "9 of 10" in lines
    assert "NOT byte for byte; 0 rejected, 1 lost" in lines


@pytest.mark.parametrize(("same", "says"), [(True, "the same rows as"), (False, "OTHER rows than")])
def test_a_replay_with_other_rows_is_reported(same: bool, says: str) -> None:
    assert says in "\n".join(story.replay_lines(REPLAYED | {"same_rows_as_tail": same}, DIGEST))


def test_a_replay_with_another_digest_is_reported() -> None:
    lines = "\n".join(story.replay_lines(REPLAYED | {"digest": OTHER}, DIGEST))
    assert "ANOTHER digest" in lines


@pytest.mark.parametrize(
    ("stage", "number", "value"),
    [
        ("replay", "same_rows_as_tail", False),
        ("replay", "digest", OTHER),
        ("record", "intact", False),
        ("record", "lost", 1),
        ("record", "rejected", 1),
        ("corrected", "replay_digest", OTHER),
    ],
)
def test_a_demo_is_sound_only_if_everything_agrees(stage: str, number: str, value: object) -> None:
    assert story.is_sound(NUMBERS)
    numbers: dict[str, Any] = deepcopy(NUMBERS)
    numbers[stage][number] = value
    assert not story.is_sound(numbers)


def test_corrections_are_reported_as_far_as_there_are_any() -> None:
    lines = "\n".join(story.correction_lines(CORRECTED))
    assert "p11 (345 keyframes, living room) and p12 (120 keyframes, dining room);" in lines
    assert 'p12 is called "dining room"' in lines
    assert "event 1300 of the log" in lines
    assert "event 1301" in lines
    without = CORRECTED | {"commands": [], "named": None, "apart": []}
    assert len(list(story.correction_lines(without))) == 1
    other = CORRECTED | {"replay_digest": OTHER}
    assert "ANOTHER digest" in "\n".join(story.correction_lines(other))


def test_lines_fit_a_terminal() -> None:
    merges = (_merge(1234, "living room", "dining room", 120), _merge(7, "hall", "hall", 3))
    lines = [
        *story.recording_lines(RECORDED, TAILED, 12_345, 8, 30.0),
        *story.replay_lines(REPLAYED, DIGEST),
        *story.map_lines(HOUSE, Settings(), 1),
        *story.merge_lines(merges),
        *story.correction_lines(CORRECTED),
        *story.correction_lines(CORRECTED | {"replay_digest": OTHER}),
    ]
    assert max(map(len, lines)) <= 97  # the demo indents by three


def test_singular_forms() -> None:
    at_once = TAILED | {"batches": 1}
    lines = "\n".join(story.recording_lines(RECORDED, at_once, 1, 1, 30.0))
    assert "through 1 room, " in lines
    assert "with 1 detection are in the log" in lines
    assert "in 1 transaction:" in lines


def test_types_of_places_are_told_in_lines_that_fit() -> None:
    seen = [detection("toilet", [1, 0]), detection("sink", [0, 1])]
    documents = [
        envelope(10 * room + k, 20.0 * room, 0.0, detections=seen if room else [])
        for room in range(7)
        for k in range(4)
    ]
    lines = list(type_lines(Map(fold(documents).view)))
    assert lines[0].startswith("by what stands in them (1 unsure): p1 bathroom ")
    assert sum(line.count("bathroom") for line in lines) == 6
    assert len(lines) > 1
    assert all(len(line) <= 93 for line in lines)
    assert list(type_lines(Map(fold(documents[:4]).view))) == []
