"""What `changes` says of two maps: what is sure, one sentence each, the farthest moves first."""

import json
import math
from pathlib import Path
from typing import Any

import pytest

from eventsrc.base.errors import MisuseError
from eventsrc.envelope.commands import UseSettings
from projections.ask.object_changes import Point, keyframes_looking
from projections.ask.what_changed import MapChanges, changes_text, map_changes
from projections.fold.presence import would_see
from projections.fold.settings import Settings
from projections.history import LogTimeline
from projections.map.records import KeyframeRecord
from projections.surfaces.python import Timeline, fold
from tests.support.commands import Commands
from tests.support.folds import Folded
from tests.support.logs import append_command, command, write_log
from tests.unit.test_moved_things import ROOM, run

SETTINGS = Settings(fusion="evidence")
AWAY = {name: at for name, at in ROOM.items() if name != "plant"}
LATER = AWAY | {"chair": (7.0, 2.0), "bed": (3.0, 2.2)}
"""The plant is gone, the chair elsewhere, and a bed is new."""


def changed(*runs: list[dict[str, Any]], before: int = 1) -> MapChanges:
    """What changed after the first ``before`` of some runs."""
    first, second = Folded.start(SETTINGS), Folded.start(SETTINGS)
    for number, documents in enumerate(runs):
        second.extend(documents)
        if number < before:
            first.extend(documents)
    return map_changes(first.view, second.view)


def test_moved_missing_and_new_are_told_apart() -> None:
    found = changed(run("a", ROOM), run("b", LATER))
    told = [(c.kind, c.class_name) for c in found.changes]
    assert told == [("moved", "chair"), ("missing", "plant"), ("new", "bed")]
    moved, missing, new = found.changes
    assert moved.moved_m == pytest.approx(6.0, abs=0.5)
    assert moved.from_ is not None
    assert math.dist(moved.from_, ROOM["chair"]) < 0.3
    assert moved.seen.run_id == new.seen.run_id == "b"
    assert (missing.seen.run_id, missing.to) == ("a", None)
    assert (new.from_, new.moved_m) == (None, None)
    assert found.document()["counts"] == {"moved": 1, "missing": 1, "new": 1, "back": 0}
    lines = changes_text(found).splitlines()
    assert lines[0].startswith("chair obj-")
    assert " moved 6.0" in lines[0]
    assert " is missing from (4.0" in lines[1]
    assert "last seen 2026-" in lines[1]
    assert " is new at (3.0" in lines[2]
    assert "and 1 more" not in changes_text(found, most=1)


def test_what_the_later_run_saw_once_more_is_not_surely_missing() -> None:
    """The later run's only detection may be of another plant at that spot, so it is not sure."""
    glimpse = next(
        document
        for document in run("b", ROOM)
        if any(seen["class"] == "plant" for seen in document["detections"])
    )
    rest = [d for d in run("b", AWAY) if d["keyframe_id"] != glimpse["keyframe_id"]]
    found = changed(run("a", ROOM), [glimpse, *rest])
    assert (found.changes, found.unsure) == ((), 1)


def test_what_was_often_overlooked_before_is_not_surely_missing() -> None:
    """A plant that only every fourth look saw is missed as easily as it is gone."""
    documents, looks = run("a", ROOM), 0
    for document in documents:
        seen = [each for each in document["detections"] if each["class"] == "plant"]
        if seen:
            looks += 1
        if seen and looks % 4:
            document["detections"].remove(seen[0])
    found = changed(documents, run("b", AWAY))
    assert found.changes == ()


def test_a_move_is_not_sure_until_the_old_place_was_looked_at_again() -> None:
    """Another chair that looks the same may stand where this run has not been."""
    elsewhere = [document for document in run("b", LATER) if document["map_x"] >= 4.0]
    found = changed(run("a", ROOM), elsewhere)
    assert [c.kind for c in found.changes] == ["missing", "new"]
    assert found.unsure == 1


def test_what_was_looked_for_along_one_line_of_sight_is_not_surely_missing() -> None:
    """What stands before the plant now may hide it from there."""
    from_the_left = [document for document in run("b", AWAY) if document["map_x"] <= 3.2]
    found = changed(run("a", ROOM), from_the_left)
    assert (found.changes, found.unsure) == ((), 1)


def test_what_is_often_overlooked_is_not_new_after_few_looks() -> None:
    documents, looks = run("b", LATER), 0
    for document in documents:
        seen = [each for each in document["detections"] if each["class"] == "bed"]
        if seen:
            looks += 1
        if seen and looks % 4:
            document["detections"].remove(seen[0])
    kinds = [
        [c.kind for c in changed(run("a", ROOM, passes=1), later).changes]
        for later in (run("b", LATER), documents)
    ]
    assert kinds == [["moved", "missing", "new"], ["moved", "missing"]]


def test_what_comes_back_is_back_and_not_new() -> None:
    found = changed(run("a", ROOM), run("b", AWAY), run("c", ROOM), before=2)
    assert [(c.kind, c.class_name) for c in found.changes] == [("back", "plant")]
    assert found.changes[0].seen.run_id == "c"


def test_where_nothing_stands_elsewhere_nothing_changed() -> None:
    found = changed(run("a", ROOM), run("b", ROOM))
    assert found.changes == ()
    assert changes_text(found) == "nothing changed for sure\n"


def test_the_keyframes_that_look_are_found_among_those_near_by() -> None:
    """The same as by the rule of `projections.fold.presence`, one keyframe after the other."""
    view = Folded.start(SETTINGS).extend(run("a", ROOM) + run("b", LATER)).view
    counts = []
    for record in view.objects.values():
        vantages = {_at(k) for k in view.sightings(record)}
        looking = [
            keyframe.ordinal
            for keyframe in view.keyframes
            if keyframe.pose is not None
            and would_see(keyframe.pose, SETTINGS.camera.constants, record.spot)
            and any(_is_similar(_at(keyframe), record.spot, each) for each in vantages)
        ]
        assert [k.ordinal for k in keyframes_looking(view, record, view)] == looking
        counts.append(len(looking))
    assert 0 < min(counts) < max(counts) < len(view.keyframes)


def _at(keyframe: KeyframeRecord) -> Point:
    assert keyframe.pose is not None
    return keyframe.pose.x_m, keyframe.pose.y_m


def _is_similar(here: Point, thing: Point, there: Point) -> bool:
    far, usual = math.dist(here, thing), math.dist(there, thing)
    dot = sum((t - a) * (t - b) for t, a, b in zip(thing, here, there, strict=True))
    near = math.dist(here, there) <= 1.1 and max(far, usual) <= 1.6 * min(far, usual)
    return near and dot >= 0.87 * far * usual


def test_what_was_never_looked_at_is_not_new() -> None:
    """The first run sees the left half of the room only: the rest is unknown, not new."""
    first = [document for document in run("a", ROOM) if document["map_x"] < 1.5]
    assert changed(first, run("b", ROOM)).changes == ()


@pytest.fixture
def log(tmp_path: Path) -> Path:
    folder = write_log(tmp_path / "log", [*run("a", ROOM), *run("b", LATER)])
    append_command(folder, command(UseSettings, settings={"fusion": "evidence"}))
    return folder


def test_moments_are_runs_days_and_points(log: Path) -> None:
    ends = len(run("a", ROOM)), len(run("a", ROOM)) + len(run("b", LATER))
    with LogTimeline(log) as timeline:
        assert timeline.moment("a", is_end=False) == 0
        assert timeline.moment("a", is_end=True) == timeline.moment("b", is_end=False) == ends[0]
        assert timeline.moment("b", is_end=True) == ends[1]
        assert timeline.moment("2026-03-23", is_end=True) == 0
        assert timeline.moment("2026-03-24", is_end=False) == 0
        assert timeline.moment("2026-03-24", is_end=True) == timeline.moment("end", is_end=True)
        assert timeline.moment("b:0", is_end=False) == ends[0] + 1
        with pytest.raises(MisuseError, match=r"no run 'c' in this log; .*a, b; or give a day"):
            timeline.moment("c", is_end=False)
        with pytest.raises(MisuseError, match="exchange them"):
            timeline.changes(timeline.end, ends[0], known_at=timeline.end)
        by_default, by_run = timeline.changes(), timeline.changes(timeline.moment("a", is_end=True))
    assert by_default == by_run
    assert len(by_default.changes) == 3


def test_python_says_the_same(log: Path, tmp_path: Path) -> None:
    document = Commands.in_folder(tmp_path)("changes", log, "--json").json
    with Timeline(log) as timeline:
        assert json.loads(json.dumps(timeline.changes("b").document())) == document
        before, after = timeline.at("a:95"), timeline.at()
        assert timeline.changes() == fold(log).changes(fold(log, at="a:95", known_at="end"))
        assert after.changes(after).changes == ()
        assert before.digest != after.digest


def test_the_command_says_a_sentence_for_each_change(log: Path, tmp_path: Path) -> None:
    mapfold = Commands.in_folder(tmp_path)
    said = mapfold("changes", log)
    assert len(said.out.splitlines()) == 3
    document = mapfold("changes", log, "--since", "b", "--until", "2026-03-24", "--json").json
    assert [each["sentence"] for each in document["changes"]] == said.out.splitlines()
    assert document["changes"][0]["from"] is not None
    refused = mapfold("changes", log, "--preset", "classic", code=2).err
    assert "only a map with fusion by evidence knows what has changed" in refused
    early = mapfold("changes", log, "--until", "0", code=2).err
    assert "as known after 0 events the map has no fusion by evidence" in early
