"""The demo's report: the numbers of each stage, and what did not agree."""

from dataclasses import replace

import pytest

from projections.database import RebuildReport
from projections.database.labels import LABELS, TABLE
from projections.demo import report
from projections.demo.mapping import Folded, Part, RoomMerge, most_telling
from projections.demo.recording import Followed, Recorded
from projections.demo.report import DemoResult
from projections.model.view import MapView
from projections.settings import Settings

RECORDED = Recorded(
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
FOLDED = Folded(MapView(Settings()), (), (), "abcdef0123456789" * 4, 0.1)
REPLAYED = RebuildReport(
    events=10,
    digest=FOLDED.digest,
    counts={},
    rows=dict.fromkeys([*LABELS, TABLE], 2),
    fold_s=0.1,
    total_s=0.2,
    hnsw=None,
)


def _merge(offset: int, one: str, other: str, smaller: int) -> RoomMerge:
    parts = Part("sim-1-a_p0", 30, one), (Part("sim-1-a_p1", smaller, other),)
    return RoomMerge(offset, "sim-1-a", offset + 1, "hall", *parts, places_before=5)


def _result() -> DemoResult:
    return DemoResult(1, Settings(), RECORDED, FOLLOWED, REPLAYED, True, FOLDED, lost=None)  # type: ignore[arg-type]


def test_a_merge_across_rooms_is_preferred_to_a_larger_one_within_a_room() -> None:
    within, across = _merge(3, "hall", "hall", 29), _merge(7, "hall", "study", 12)
    assert most_telling([within, across]) is across
    assert most_telling([within]) is within
    assert most_telling([]) is None


def test_no_merges() -> None:
    assert list(report.tell_merges(())) == ["   no two places became one on this drive"]


def test_a_merge_is_reported_with_its_numbers() -> None:
    lines = "\n".join(report.tell_merges((_merge(7, "hall", "study", 12),)))
    for wanted in ("p0 (30 keyframes, hall)", "p1 (12 keyframes, study)", "event 7", "5 places"):
        assert wanted in lines
    assert "such moments" not in lines


def test_an_incomplete_log_is_reported() -> None:
    good = "\n".join(report.tell_recording(RECORDED, FOLLOWED, 5, 8, 30.0))
    assert "byte for byte" in good
    assert "NOT" not in good
    torn = replace(RECORDED, recorded=9, intact=False, lost=1)
    lines = "\n".join(report.tell_recording(torn, FOLLOWED, 5, 8, 30.0))
    assert "9 of 10" in lines
    assert "NOT byte for byte; 0 rejected, 1 lost" in lines


@pytest.mark.parametrize(("same", "says"), [(True, "the same rows as"), (False, "OTHER rows than")])
def test_a_replay_with_other_rows_is_reported(same: bool, says: str) -> None:
    assert says in "\n".join(report.tell_replay(REPLAYED, FOLDED, same))


def test_a_replay_with_another_digest_is_reported() -> None:
    lines = "\n".join(report.tell_replay(replace(REPLAYED, digest="0" * 64), FOLDED, True))
    assert "ANOTHER digest" in lines


def test_a_demo_is_sound_only_if_everything_agrees() -> None:
    assert _result().sound
    assert not replace(_result(), same_rows=False).sound
    assert not replace(_result(), recorded=replace(RECORDED, intact=False)).sound
    assert not replace(_result(), recorded=replace(RECORDED, lost=1)).sound
    assert not replace(_result(), replayed=replace(REPLAYED, digest="0" * 64)).sound


def test_lines_fit_a_terminal() -> None:
    merges = (_merge(1234, "living room", "dining room", 120), _merge(7, "hall", "hall", 3))
    lines = [
        *report.tell_recording(RECORDED, FOLLOWED, 12_345, 8, 30.0),
        *report.tell_replay(REPLAYED, FOLDED, True),
        *report.tell_map(FOLDED, Settings(), 1),
        *report.tell_merges(merges),
    ]
    assert max(map(len, lines)) <= 100


def test_singular_forms() -> None:
    at_once = replace(FOLLOWED, batches=1)
    lines = "\n".join(report.tell_recording(RECORDED, at_once, 1, 1, 30.0))
    assert "through 1 room, " in lines
    assert "with 1 detection are in the log" in lines
    assert "in 1 transaction:" in lines
