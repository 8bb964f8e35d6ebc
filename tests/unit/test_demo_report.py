"""The demo's report: the numbers of each stage, and what did not agree."""

from dataclasses import replace
from typing import Any

import pytest

from projections.fold.settings import Settings
from projections.map.view import MapView
from projections.postgres import RebuildReport
from projections.postgres.labels import LABELS, TABLE
from projections.surfaces.demo import story
from projections.surfaces.demo.acts import Corrected, Explored, RoomMerge, RoomPart, most_telling
from projections.surfaces.demo.recorded_run import Followed, RecordedRun
from projections.surfaces.demo.story import DemoResult, type_lines
from projections.surfaces.python import Map
from tests.support.envelopes import detection, envelope
from tests.support.folds import fold

RECORDED = RecordedRun(
    run_id="sim-1-a",
    published=10,
    recorded=10,
    intact=True,
    rejected=0,
    lost=0,
    drive_seconds=61.0,
    log_bytes=2_000_000,
    seconds=3.0,
)
FOLLOWED = Followed(events=10, batches=4, median_delay_s=0.04, worst_delay_s=0.09)
HOUSE = Map(MapView(Settings()))
EXPLORED = Explored(HOUSE, (), 0.1)
REPLAYED = RebuildReport(
    events=10,
    digest=HOUSE.digest,
    counts={},
    rows=dict.fromkeys([*LABELS, TABLE], 2),
    fold_s=0.1,
    total_s=0.2,
    hnsw=None,
)


def _merge(offset: int, one: str, other: str, smaller: int) -> RoomMerge:
    parts = RoomPart("sim-1-a_p0", 30, one), (RoomPart("sim-1-a_p1", smaller, other),)
    return RoomMerge(offset, "sim-1-a", offset + 1, "hall", *parts, places_before=5)


CORRECTED = Corrected(
    ({"kind": "undo-merge", "offset": 1300}, {"kind": "name-place", "offset": 1301}),
    RoomPart("sim-1-a_p12", 120, "dining room"),
    (RoomPart("sim-1-a_p11", 345, "living room"), RoomPart("sim-1-a_p12", 120, "dining room")),
    HOUSE,
    REPLAYED,
    0.3,
)


def _result() -> DemoResult:
    lost: Any = None
    return DemoResult(
        1, Settings(), RECORDED, FOLLOWED, REPLAYED, True, EXPLORED, CORRECTED, lost=lost
    )


def test_a_merge_across_rooms_is_preferred_to_a_larger_one_within_a_room() -> None:
    within, across = _merge(3, "hall", "hall", 29), _merge(7, "hall", "study", 12)
    assert most_telling([within, across]) is across
    assert most_telling([within]) is within
    assert most_telling([]) is None


def test_no_merges() -> None:
    assert list(story.merge_lines(())) == ["   no two places became one on this drive"]


def test_a_merge_is_reported_with_its_numbers() -> None:
    lines = "\n".join(story.merge_lines((_merge(7, "hall", "study", 12),)))
    for wanted in ("p0 (30 keyframes, hall)", "p1 (12 keyframes, study)", "event 7", "5 places"):
        assert wanted in lines
    assert "such moments" not in lines


def test_an_incomplete_log_is_reported() -> None:
    good = "\n".join(story.recording_lines(RECORDED, FOLLOWED, 5, 8, 30.0))
    assert "byte for byte" in good
    assert "NOT" not in good
    torn = replace(RECORDED, recorded=9, intact=False, lost=1)
    lines = "\n".join(story.recording_lines(torn, FOLLOWED, 5, 8, 30.0))
    assert "9 of 10" in lines
    assert "NOT byte for byte; 0 rejected, 1 lost" in lines


@pytest.mark.parametrize(("same", "says"), [(True, "the same rows as"), (False, "OTHER rows than")])
def test_a_replay_with_other_rows_is_reported(same: bool, says: str) -> None:
    assert says in "\n".join(story.replay_lines(REPLAYED, HOUSE, same))


def test_a_replay_with_another_digest_is_reported() -> None:
    lines = "\n".join(story.replay_lines(replace(REPLAYED, digest="0" * 64), HOUSE, True))
    assert "ANOTHER digest" in lines


def test_a_demo_is_sound_only_if_everything_agrees() -> None:
    assert _result().sound
    assert not replace(_result(), same_rows=False).sound
    assert not replace(_result(), recorded=replace(RECORDED, intact=False)).sound
    assert not replace(_result(), recorded=replace(RECORDED, lost=1)).sound
    other = replace(REPLAYED, digest="0" * 64)
    assert not replace(_result(), replayed=other).sound
    assert not replace(_result(), corrected=replace(CORRECTED, replayed=other)).sound


def test_corrections_are_reported_as_far_as_there_are_any() -> None:
    lines = "\n".join(story.correction_lines(CORRECTED))
    assert "p11 (345 keyframes, living room) and p12 (120 keyframes, dining room);" in lines
    assert 'p12 is called "dining room"' in lines
    assert "event 1300 of the log" in lines
    assert "event 1301" in lines
    without = replace(CORRECTED, commands=(), named=None, apart=())
    assert len(list(story.correction_lines(without))) == 1
    other = replace(CORRECTED, replayed=replace(REPLAYED, digest="0" * 64))
    assert "ANOTHER digest" in "\n".join(story.correction_lines(other))


def test_lines_fit_a_terminal() -> None:
    merges = (_merge(1234, "living room", "dining room", 120), _merge(7, "hall", "hall", 3))
    lines = [
        *story.recording_lines(RECORDED, FOLLOWED, 12_345, 8, 30.0),
        *story.replay_lines(REPLAYED, HOUSE, True),
        *story.map_lines(HOUSE, Settings(), 1),
        *story.merge_lines(merges),
        *story.correction_lines(CORRECTED),
        *story.correction_lines(replace(CORRECTED, replayed=replace(REPLAYED, digest="0" * 64))),
    ]
    assert max(map(len, lines)) <= 100


def test_singular_forms() -> None:
    at_once = replace(FOLLOWED, batches=1)
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
    assert lines[0].startswith("   by what stands in them (1 unsure): p1 bathroom ")
    assert sum(line.count("bathroom") for line in lines) == 6
    assert len(lines) > 1
    assert all(len(line) <= 96 for line in lines)
    assert list(type_lines(Map(fold(documents[:4]).view))) == []
