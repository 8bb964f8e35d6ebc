"""What `why`, `merges`, `diff` and `bisect` say of commands, in a small log with one merge."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from eventsrc.base.errors import MisuseError
from eventsrc.envelope.commands import (
    Command,
    CorrectPoses,
    DropDetection,
    ForgetKeyframes,
    Join,
    KeepApart,
    NamePlace,
    RigidTransform,
    SameObject,
    Undo,
    UndoMerge,
    UseSettings,
)
from eventsrc.envelope.model import DetId, KeyframeId, Offset, RunId
from projections.fold.settings import Settings
from projections.history import LogTimeline, NoSuchThing
from projections.history.diff_rendering import difference_text, whatif_text
from projections.history.merge_reasons import (
    merge_document,
    object_merge_document,
    refusal_document,
)
from projections.history.rendering import (
    merge_text,
    merges_text,
    object_merges_text,
    refusals_text,
)
from projections.history.rule_folds import Rules
from projections.history.whatif import command_trials, what_if
from projections.map.state_output import state_document, state_text
from tests.support.envelopes import detection, envelope
from tests.support.walks import anchor, write_mixed_log

CUP = detection("cup", [1.0, 0.0], det_id="the-cup")
OTHER_CUP = detection("cup", [0.0, 1.0], det_id="other-cup")
CUP_AGAIN = detection("cup", [0.0, 1.0], det_id="cup-again")

CORRIDOR = [
    envelope(1, 0.0),
    envelope(2, 1.0),
    envelope(3, 2.0),  # three within 1 m: run-a_p0 around 1.0, founded by run-a:2
    envelope(4, 6.0),
    envelope(5, 5.0, detections=[CUP]),
    envelope(6, 4.0),  # run-a_p1 around 5.0, founded by run-a:5
    envelope(7, 9.0),  # noise
    envelope(8, 3.0, detections=[OTHER_CUP]),  # makes 2.0, 3.0 and 4.0 core
    envelope(9, 5.0, detections=[CUP_AGAIN]),
    envelope(10, 20.0),
    envelope(11, 21.0),
    envelope(12, 22.0),  # run-a_p2 around 21.0, founded by run-a:11
]
RULES = Settings(eps_m=1.0, min_samples=3)
SAID: dict[str, Any] = {"issued_by": "ann@lab", "reason": "a door"}
FIRST, SECOND, THIRD = anchor("run-a", 2), anchor("run-a", 5), anchor("run-a", 11)
UNDO_MERGE = UndoMerge(command_id="c1", merge_offset=Offset(7), places=(FIRST, SECOND), **SAID)
JOIN = Join(command_id="c2", places=(FIRST, THIRD), **SAID)
KITCHEN = NamePlace(command_id="c3", place=SECOND, name="kitchen", **SAID)
ONE_CUP = SameObject(command_id="c4", det_ids=(DetId("the-cup"), DetId("cup-again")), **SAID)
BY = "(ann@lab: a door)"

Open = Callable[..., LogTimeline]


@pytest.fixture
def corridor(tmp_path: Path) -> Iterator[Open]:
    opened: list[LogTimeline] = []

    def open_with(*commands: Command) -> LogTimeline:
        log = write_mixed_log(tmp_path / "log", [*CORRIDOR, *commands])
        opened.append(LogTimeline(log, RULES))
        return opened[-1]

    yield open_with
    for timeline in opened:
        timeline.reader.close()


def test_a_command_changes_earlier_maps_from_the_point_where_it_is_known(corridor: Open) -> None:
    timeline = corridor(UNDO_MERGE, Undo(command_id="c9", undone="c1", **SAID))
    counts = [
        [len(timeline.at(end, known_at=known_at).places) for known_at in (12, 13, 14)]
        for end in (8, 12)
    ]
    assert counts == [[1, 2, 1], [2, 3, 2]]
    assert [len(timeline.at(end).places) for end in (12, 13, 14)] == [2, 3, 2]


def test_why_names_the_command_that_refused_a_merge(corridor: Open) -> None:
    timeline = corridor(UNDO_MERGE)
    told = [(e.cause.offset, e.what, e.text) for e in timeline.why("run-a_p0").entries[1:]]
    near = "run-a:6 and run-a:8 are core points 1.000 m apart"
    assert told == [
        (
            7,
            "refused",
            f"merge with run-a_p1 refused; {near}; kept apart by undo-merge c1 {BY}",
        ),
        (12, "undo-merge", f"kept apart from run-a_p1 by undo-merge c1 {BY}"),
    ]
    entry = timeline.why("run-a_p0").document()["entries"][-1]
    assert entry["cause"] == "command"
    assert entry["time"] == "2026-03-25T00:53:20.000Z"
    assert entry["command"] == {
        "offset": 12,
        "command_id": "c1",
        "kind": "undo-merge",
        "issued_by": "ann@lab",
        "reason": "a door",
    }


def test_why_two_keyframes_are_kept_apart(corridor: Open) -> None:
    story = corridor(UNDO_MERGE).why_same("run-a:1", "run-a:4")
    assert story.summary == ("not in one place: run-a:1 is in run-a_p0; run-a:4 is in run-a_p1")
    assert [e.what for e in story.entries] == ["placed", "placed", "refused", "undo-merge"]
    assert story.entries[-1].text == f"kept apart by undo-merge c1 {BY}"


def test_why_two_keyframes_are_joined(corridor: Open) -> None:
    timeline = corridor(JOIN)
    story = timeline.why_same("run-a:1", "run-a:10")
    assert story.facts["same"] is True
    assert story.facts["since"] == 11
    assert story.entries[-1].text == f"joined by join c2 {BY}"


def test_a_merge_that_a_join_made_says_so(corridor: Open) -> None:
    timeline = corridor(JOIN)
    merge = timeline.merges()[-1]
    known = timeline.knowing()
    assert merge.cause.offset == 11
    assert "run-a_p2 (joined)" in merges_text(known.history, timeline.merges(), known.end)
    assert f"20.000 m apart, joined by join c2 {BY}" in merge_text(known.history, merge)
    document = merge_document(known.history, merge)
    assert [j["command"]["command_id"] for j in document["joined"]] == ["c2"]
    assert document["chains"] == []
    assert "joined" not in merge_document(known.history, timeline.merges()[0])


def test_refused_merges(corridor: Open) -> None:
    known = corridor(UNDO_MERGE).knowing()
    (refusal,) = known.refusals()
    assert known.refusals(Offset(7)) == []
    document = refusal_document(known.history, refusal)
    assert document["offset"] == 7
    assert document["places"] == ["run-a_p0", "run-a_p1"]
    assert document["apart"] == ["run-a:2", "run-a:5"]
    assert document["command"]["command_id"] == "c1"
    table = refusals_text(known.history, known.refusals())
    assert table.splitlines()[1].endswith(
        f"run-a:8  run-a_p0, run-a_p1   1.000 m  undo-merge c1 {BY}"
    )
    assert refusals_text(known.history, []) == "no merge was refused\n"


def test_a_later_command_on_the_same_two_counts(corridor: Open) -> None:
    apart = KeepApart(command_id="c5", places=(FIRST, THIRD), **SAID)
    timeline = corridor(apart, Join(command_id="c6", places=(FIRST, THIRD), **SAID))
    texts = [e.text for e in timeline.why("run-a_p0").entries]
    assert f"run-a:2 and run-a:11 kept apart until a later join, by keep-apart c5 {BY}" in texts
    assert f"joined run-a:2 and run-a:11 by join c6 {BY}" in texts


def texts_of(timeline: LogTimeline, place: str) -> list[str]:
    """What `why` says of the commands about a place, less who gave them."""
    entries = [e for e in timeline.why(place).entries if e.what in ("keep-apart", "join")]
    return [e.text.removesuffix(f" {BY}") for e in entries]


IN_NO_PLACE = anchor("run-a", 7)


def test_why_says_that_a_command_on_a_keyframe_in_no_place_has_no_effect(corridor: Open) -> None:
    apart = KeepApart(command_id="c5", places=(FIRST, IN_NO_PLACE), **SAID)
    nowhere = "without effect here as that is in no place"
    assert texts_of(corridor(apart), "run-a_p0") == [
        f"kept apart from run-a:7, {nowhere}, by keep-apart c5"
    ]


def test_why_says_that_a_join_with_a_keyframe_in_no_place_has_no_effect(corridor: Open) -> None:
    join = Join(command_id="c5", places=(FIRST, IN_NO_PLACE), **SAID)
    nowhere = "without effect here as one of them is in no place"
    assert texts_of(corridor(join), "run-a_p0") == [
        f"joined run-a:2 and run-a:7, {nowhere}, by join c5"
    ]


def test_why_says_that_two_keyframes_in_one_cell_are_not_kept_apart(tmp_path: Path) -> None:
    pair = anchor("run-a", 1), anchor("run-a", 2)
    apart = KeepApart(command_id="c5", places=pair, **SAID)
    log = write_mixed_log(tmp_path / "close", [*(envelope(k, 0.1 * k) for k in range(4)), apart])
    undivided = "without effect here as no command divides a cell of core points"
    with LogTimeline(log, RULES) as timeline:
        assert len(timeline.at(5).places) == 1
        assert texts_of(timeline, "run-a_p0") == [
            f"run-a:1 and run-a:2 kept apart, {undivided}, by keep-apart c5"
        ]


def test_why_says_that_a_join_of_places_that_are_kept_apart_has_no_effect(corridor: Open) -> None:
    """They are kept apart by other keyframes than those joined."""
    apart = KeepApart(command_id="c5", places=(anchor("run-a", 1), anchor("run-a", 10)), **SAID)
    refused = "without effect here as their places are kept apart"
    assert texts_of(corridor(apart, JOIN), "run-a_p2") == [
        "kept apart from run-a_p0 by keep-apart c5",
        f"joined run-a:2 and run-a:11, {refused}, by join c2",
    ]


def test_names_of_places(corridor: Open) -> None:
    newer = NamePlace(command_id="c7", place=FIRST, name="hall", **SAID)
    timeline = corridor(KITCHEN, newer)
    assert [p.name for p in timeline.at(6, known_at=13).places.values()] == [None, "kitchen"]
    assert [p.name for p in timeline.at(12, known_at=13).places.values()] == ["kitchen", None]
    assert [p.name for p in timeline.at(12, known_at=14).places.values()] == ["hall", None]
    assert timeline.why("kitchen", 6, known_at=13).subject == "run-a_p1"
    assert timeline.why("kitchen", 12, known_at=13).subject == "run-a_p0"
    story = timeline.why("hall")
    assert story.facts["name"] == "hall"
    assert story.summary.startswith('called "hall"; 8 keyframes around')
    assert [e.text for e in story.entries[-2:]] == [
        f'named "kitchen" until a later name, by name-place c3 {BY}',
        f'named "hall" by name-place c7 {BY}',
    ]
    with pytest.raises(NoSuchThing, match="near it: hall"):
        timeline.why("halls")


def test_a_name_that_two_places_have_is_refused(corridor: Open) -> None:
    also = NamePlace(command_id="c7", place=THIRD, name="kitchen", **SAID)
    with pytest.raises(MisuseError, match=r"means 2 places; .*:\n  run-a_p0 .*\n  run-a_p2 "):
        corridor(KITCHEN, also).why("kitchen")


def test_conditions_over_names_and_refusals(corridor: Open) -> None:
    timeline = corridor(KITCHEN, UNDO_MERGE)
    asked = {
        "named('kitchen')": 5,
        "place_called('kitchen') == 'run-a_p1'": 5,
        "name('run-a_p1') == 'kitchen'": 5,
        "refused_count > 0": 7,
    }
    for condition, offset in asked.items():
        found = timeline.bisect(condition).found
        assert found is not None
        assert found.cause.offset == offset
    assert timeline.bisect("refused_count > 0", known_at=13).found is None


def test_the_difference_names_the_commands_in_between(corridor: Open) -> None:
    diff = corridor(KITCHEN, UNDO_MERGE).diff(12, 14)
    text = difference_text(diff, most=None)
    assert "commands   2 in between\n" in text
    assert f"  12  name-place c3 {BY}\n  13  undo-merge c1 {BY}\n" in text
    assert '  + run-a_p1 "kitchen": 4 keyframes around (5.00, 0.00)\n' in text
    assert [c["command_id"] for c in diff.document()["commands"]] == ["c3", "c1"]
    assert diff.document()["places"]["formed"][0]["name"] == "kitchen"


def test_the_difference_of_a_name_alone(corridor: Open) -> None:
    diff = corridor(KITCHEN).diff(12, 13)
    assert '  ~ run-a_p0: no name → "kitchen"\n' in difference_text(diff, most=None)
    assert not diff.same


def test_a_difference_finds_a_merge_that_a_later_command_made_earlier(corridor: Open) -> None:
    """A join that is recorded after both maps merged them at the founding of the second."""
    diff = corridor(JOIN).diff(12, 13)
    assert diff.absorbed["run-a_p2"][0] == "run-a_p0"
    assert diff.absorbed["run-a_p2"][1].offset == 11


def test_a_search_does_not_depend_on_objects_that_merge_later(corridor: Open) -> None:
    timeline = corridor(ONE_CUP)  # by the event at offset 8
    for end, asked in ((8, 2), (9, 2 + 9)):
        found = timeline.bisect("object_count > 50", end=Offset(end), known_at=timeline.end)
        assert found.document()["maps_asked"] == asked


def test_objects_made_one(corridor: Open) -> None:
    timeline = corridor(ONE_CUP)
    known = timeline.knowing()
    (merge,) = known.object_merges()
    before, after = timeline.at(8, known_at=13), timeline.at(9, known_at=13)
    assert (len(before.objects), len(after.objects)) == (2, 1)
    assert [o.object for o in before.observations] == [0, 1]
    assert [o.object for o in after.observations] == [0, 0, 0]
    document = object_merge_document(known.history, merge)
    assert document["offset"] == 8
    assert document["class_name"] == "cup"
    assert document["absorbed"] in object_merges_text(known.history, [merge])
    story = timeline.why(document["survivor"])
    assert story.facts["det_ids"] == ["the-cup", "other-cup", "cup-again"]
    assert "seen 3 times" in story.summary
    assert [e.what for e in story.entries][-2:] == ["fused", "same-object"]
    assert story.entries[-1].text == f"fused the-cup and cup-again by same-object c4 {BY}"
    ended = timeline.why(document["absorbed"])
    assert ended.summary.startswith(f"fused into {document['survivor']} at offset 8")
    assert [timeline.facts(Offset(end), known_at=Offset(13)).object_count() for end in (8, 9)] == [
        2,
        1,
    ]
    for condition, offset in (
        ("object_count('cup') == 1 and keyframe_count > 7", 8),
        ("object_count >= 2", 7),  # and false again after the next event
    ):
        found = timeline.bisect(condition).found
        assert found is not None
        assert found.cause.offset == offset


def test_moved_keyframes_of_a_place_name_the_command(corridor: Open) -> None:
    moved = RigidTransform.of(0.0, 5.0, 0.0)
    first, last = KeyframeId(10), KeyframeId(11)
    command = CorrectPoses(
        command_id="c8", run_id=RunId("run-a"), transform=moved, first=first, last=last, **SAID
    )
    texts = [e.text for e in corridor(command).why("run-a_p0").entries]
    assert not any("moved" in text for text in texts)


def test_all_keyframes_of_a_place_moved(corridor: Open) -> None:
    moved = RigidTransform.of(0.0, 5.0, 0.0)
    command = CorrectPoses(
        command_id="c8", run_id=RunId("run-a"), transform=moved, first=KeyframeId(10), **SAID
    )
    timeline = corridor(command)
    (third,) = [p for p in timeline.at().places.values() if p.centroid_x > 15]
    assert third.centroid_y == 5.0
    entry = timeline.why(third.place_id).entries[-1]
    assert entry.text == f"3 keyframes of it moved by correct-poses c8 {BY}"


def test_the_log_s_settings_are_used_from_where_they_are_known(tmp_path: Path) -> None:
    settings = UseSettings(command_id="c1", settings={"eps_m": 1.0, "min_samples": 9}, **SAID)
    log = write_mixed_log(tmp_path / "log", [*CORRIDOR, settings])
    with LogTimeline(log) as timeline:
        assert timeline.at(12).settings == Settings()
        assert timeline.at(12, known_at=13).settings == Settings(eps_m=1.0, min_samples=9)
        assert timeline.at(13).places == {}
        assert timeline.diff(12, 13).counts[1]["places"] == 0


def test_whatif_without_a_command_says_what_it_was_for(corridor: Open) -> None:
    timeline = corridor(
        KITCHEN,
        UNDO_MERGE,
        ForgetKeyframes(
            command_id="c9",
            run_id=RunId("run-a"),
            first=KeyframeId(10),
            last=KeyframeId(12),
            **SAID,
        ),
    )
    corrections = timeline.corrections()
    trials = command_trials(timeline.commands(), ["c1", "c9", "c3"], lambda _: RULES)
    found = what_if(timeline.reader.path, Rules(RULES, corrections), trials, timeline.end)
    text = whatif_text(found, most=None)
    differ = "without undo-merge c1: places differ from offset 7 on; objects are the same\n"
    assert f"{differ}  left out: undo-merge c1 {BY}\n" in text
    assert '  run-a_p1: "kitchen" in the base, no name here\n' in text
    assert "without forget-keyframes c9: places differ from offset 11 on" in text
    assert "without name-place c3: the same places and objects, event by event" in text
    assert [a["without"]["command_id"] for a in found.document()["alternatives"]] == [
        "c1",
        "c9",
        "c3",
    ]
    assert found.document()["corrections"] == corrections.fingerprint()
    with pytest.raises(NoSuchThing, match="no command 'c7' in this log; "):
        command_trials(timeline.commands(), ["c7"], lambda _: RULES)


def test_state_has_names_and_commands_only_where_there_are_any(corridor: Open) -> None:
    timeline = corridor(
        KITCHEN, DropDetection(command_id="c5", det_ids=(DetId("the-cup"),), **SAID)
    )
    before, after = timeline.at(12), timeline.at(14)
    assert "corrections" not in state_document(before, "")
    assert "name" not in state_document(before, "")["places"][0]
    assert "commands" not in state_text(before, "")
    document = state_document(after, "", Offset(14))
    assert document["places"][0]["name"] == "kitchen"
    assert document["corrections"]["known_at"] == 14
    assert document["corrections"]["fingerprint"] == timeline.corrections().fingerprint()
    assert [c["command_id"] for c in document["corrections"]["commands"]] == ["c3", "c5"]
    text = state_text(after, "", Offset(14))
    assert "commands 2 in force, of those before 14\n" in text
    assert "1 detection dropped" in text
    assert text.splitlines()[-2].split()[:3] == ["p0", "kitchen", "8"]
