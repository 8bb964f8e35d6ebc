"""Answers of a timeline over a small log with one merge."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from eventsrc.base.errors import MisuseError
from eventsrc.log import LogWriter
from projections.fold.map_errors import LogPointError
from projections.fold.settings import Settings
from projections.history import ExpressionError, LogTimeline, NoSuchThing
from projections.history.merge_reasons import merge_document
from tests.support.envelopes import detection, envelope
from tests.support.walks import write_log

CUP = detection("cup", [1.0, 0.0], det_id="the-cup")
CUP_AGAIN = detection("cup", [1.0, 0.0], det_id="the-cup-again")

CORRIDOR = [
    envelope(1, 0.0),
    envelope(2, 1.0),
    envelope(3, 2.0),  # three within 1 m: run-a_p0 around 1.0
    envelope(4, 6.0),
    envelope(5, 5.0, detections=[CUP]),
    envelope(6, 4.0),  # run-a_p1 around 5.0
    envelope(7, None, None),
    envelope(8, 9.0),  # noise
    envelope(9, 3.0),  # makes 2.0, 3.0 and 4.0 core: everything but the noise is one place
    envelope(10, 5.0, detections=[CUP_AGAIN]),
]
RULES = Settings(eps_m=1.0, min_samples=3)


@pytest.fixture
def corridor(tmp_path: Path) -> Iterator[LogTimeline]:
    with LogTimeline(write_log(tmp_path / "log", CORRIDOR), RULES) as opened:
        yield opened


def test_a_merge_with_its_chain_objects_and_edges(corridor: LogTimeline) -> None:
    (merge,) = corridor.merges()
    (cup,) = corridor.at().objects.values()
    document = merge_document(corridor.history, merge)
    links, chains = document.pop("links"), document.pop("chains")
    assert document == {
        "offset": 8,
        "time": "2026-03-24T13:00:09.000Z",
        "cause": "keyframe",
        "run_id": "run-a",
        "keyframe_id": 9,
        "number": 1,
        "survivor": "run-a_p0",
        "survivor_size": 3,
        "absorbed": ["run-a_p1"],
        "absorbed_sizes": [3],
        "objects": [cup.object_id],
        "edges": [{"a": "run-a_p0", "b": "run-a_p1", "before": 1, "after": 0}],
    }
    assert [link["distance_m"] for link in links] == [1.0]
    assert chains == [
        {
            "from": "run-a_p0",
            "to": "run-a_p1",
            "points": ["run-a:2", "run-a:3", "run-a:9", "run-a:6", "run-a:5"],
            "distances_m": [1.0, 1.0, 1.0, 1.0],
            "made_core": ["run-a:3", "run-a:9", "run-a:6"],
        }
    ]


def test_merges_before_an_offset(corridor: LogTimeline) -> None:
    assert corridor.merges(8) == []
    assert len(corridor.merges(9)) == 1


def test_a_merge_shows_from_the_next_offset_on(corridor: LogTimeline) -> None:
    assert [p.place_id for p in corridor.at(8).places.values()] == ["run-a_p0", "run-a_p1"]
    assert [p.place_id for p in corridor.at(9).places.values()] == ["run-a_p0"]
    assert corridor.bisect("merged('run-a_p1')").document()["found"]["at"] == 9


def test_why_of_a_standing_place(corridor: LogTimeline) -> None:
    story = corridor.why("run-a_p0")
    assert [(e.cause.offset, e.what) for e in story.entries] == [(2, "founded"), (8, "absorbed")]
    assert story.summary == (
        "8 keyframes around (3.25, 0.00); 0 objects + 1 seen once; next to no other place"
    )
    assert story.entries[0].text == (
        "founded: run-a:2 at (1.00, 0.00) became the first core point; "
        "members run-a:1, run-a:2, run-a:3"
    )
    assert story.entries[1].text == (
        "absorbed run-a_p1 (3 keyframes); it had 3 before; "
        "run-a:9 made run-a:3, itself and run-a:6 core points: run-a:2 (run-a_p0) –1.000 m– "
        "run-a:3 –1.000 m– run-a:9 –1.000 m– run-a:6 –1.000 m– run-a:5 (run-a_p1)"
    )


def test_why_of_an_absorbed_place(corridor: LogTimeline) -> None:
    story = corridor.why("run-a_p1")
    assert story.summary == "absorbed by run-a_p0 at offset 8 (2026-03-24T13:00:09.000Z)"
    assert story.facts["absorbed_by"]["place_id"] == "run-a_p0"
    assert [e.what for e in story.entries] == ["founded", "ended"]


def test_why_at_an_earlier_offset(corridor: LogTimeline) -> None:
    story = corridor.why("run-a_p1", 8)
    assert story.facts["stands"] is True
    assert [e.what for e in story.entries] == ["founded"]
    assert corridor.why("run-a_p1", 2).summary == ("not founded yet; run-a:6 founds it at offset 5")


def test_why_of_an_object(corridor: LogTimeline) -> None:
    (cup,) = corridor.at().objects.values()
    story = corridor.why(cup.object_id)
    assert story.summary == (
        "cup, seen 2 times (similarity at least 1.00), on average from (5.00, 0.00); in run-a_p0"
    )
    assert [(e.cause.offset, e.text) for e in story.entries] == [
        (4, "new object: the-cup, seen from (5.00, 0.00), matched no cup nearby"),
        (5, "located in run-a_p1"),
        (8, "located in run-a_p0, which absorbed run-a_p1"),
    ]


@pytest.mark.parametrize(
    ("first", "second", "summary"),
    [
        (
            "run-a:1",
            "run-a:6",
            "in one place since offset 8 (run-a:9, 2026-03-24T13:00:09.000Z); it is run-a_p0 now",
        ),
        ("run-a:1", "run-a:8", "not in one place: run-a:1 is in run-a_p0; run-a:8 is noise"),
        ("run-a:7", "run-a:8", "not in one place: run-a:7 has no pose; run-a:8 is noise"),
    ],
)
def test_why_same_of_two_keyframes(
    corridor: LogTimeline, first: str, second: str, summary: str
) -> None:
    assert corridor.why_same(first, second).summary == summary


def test_why_same_before_the_keyframes_are_recorded(corridor: LogTimeline) -> None:
    story = corridor.why_same("run-a:1", "run-a:10", 3)
    assert story.summary == ("not in one place: run-a:1 is in run-a_p0; run-a:10 has not come yet")
    assert story.facts == {"same": False, "since": None, "places": ["run-a_p0", None]}


@pytest.mark.parametrize(
    ("thing", "says"),
    [
        ("run-a_p2", "place or object 'run-a_p2' under these settings; near it: run-a_p1, run-"),
        ("kitchen", "place or object 'kitchen' under these settings; there are run-a_p0, run-"),
        ("obj-0000", "object 'obj-0000' under these settings; "),
    ],
)
def test_an_absent_id_lists_the_near_ones(corridor: LogTimeline, thing: str, says: str) -> None:
    with pytest.raises(NoSuchThing) as caught:
        corridor.why(thing)
    assert str(caught.value).startswith(f"no {says}")


def test_a_keyframe_alone_is_refused_with_its_place(corridor: LogTimeline) -> None:
    with pytest.raises(MisuseError, match="run-a:1 is a keyframe, in run-a_p0; give a place"):
        corridor.why("run-a:1")
    with pytest.raises(MisuseError, match="run-a:7 is a keyframe, in no place;"):
        corridor.why("run-a:7")


def test_an_absent_keyframe_lists_the_near_ones(corridor: LogTimeline) -> None:
    with pytest.raises(NoSuchThing, match="near it: run-a:10, run-a:9"):
        corridor.why_same("run-a:1", "run-a:12")


def test_a_condition_on_an_unknown_name_is_an_error_at_its_column(corridor: LogTimeline) -> None:
    with pytest.raises(ExpressionError, match="no place 'run-a_p9'") as caught:
        corridor.bisect("place_count < 3 and merged('run-a_p9')")
    with pytest.raises(ExpressionError, match="no keyframe 'run-a:02' in this log; near it: run-a"):
        corridor.bisect("place_of('run-a:02') != none")
    assert caught.value.column == 28


def test_bisect_gives_the_values_before_and_after(corridor: LogTimeline) -> None:
    search = corridor.bisect("place_count == 1 and keyframe_count > 5")
    assert search.found is not None
    assert search.found.cause.name == "run-a:9"
    assert search.found.before == (("place_count", 2), ("keyframe_count", 8))
    assert search.found.after == (("place_count", 1), ("keyframe_count", 9))


def test_a_scan_lists_every_turn(corridor: LogTimeline) -> None:
    search = corridor.bisect("place_count == 1", scan=True)
    assert [(t.cause.offset, t.becomes) for t in search.turns] == [(2, True), (5, False), (8, True)]
    assert search.holds == (False, True)


def test_a_condition_that_never_becomes_true(corridor: LogTimeline) -> None:
    assert corridor.bisect("place_count > 9").found is None
    assert corridor.bisect("keyframe_count >= 0").holds == (True, True)


def test_a_monotone_condition_is_evaluated_at_few_offsets(corridor: LogTimeline) -> None:
    search = corridor.bisect("keyframe_count >= 6")
    assert search.found is not None
    assert search.found.cause.offset == 5
    assert search.evaluations <= 6


def test_the_difference_of_equal_maps(corridor: LogTimeline) -> None:
    assert corridor.diff(4, 4).same
    diff = corridor.diff(8, 9)
    assert not diff.same
    assert diff.absorbed["run-a_p1"][0] == "run-a_p0"
    document = diff.document()
    assert document["places"]["gone"][0]["into"] == "run-a_p0"
    assert document["adjacency"] == [{"a": "run-a_p0", "b": "run-a_p1", "before": 1, "after": 0}]
    assert document["objects"]["changed"][0]["relocated"] is True


def test_a_point_beyond_the_log_is_refused(corridor: LogTimeline) -> None:
    for ask in (corridor.at, corridor.merges):
        with pytest.raises(LogPointError, match="give 0 to 10"):
            ask(11)
    with pytest.raises(LogPointError):
        corridor.at(-1)


def test_refresh_includes_later_events(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log", CORRIDOR[:8])
    with LogTimeline(log, RULES) as opened:
        assert opened.merges() == []
        with LogWriter(log):
            pass
        write_log(log, CORRIDOR[8:])
        assert opened.refresh() == 10
        assert len(opened.merges()) == 1
        assert opened.bisect("place_count == 1 and keyframe_count > 5").found is not None


def test_an_empty_log_has_an_empty_history(tmp_path: Path) -> None:
    with LogTimeline(write_log(tmp_path / "log", []), RULES) as opened:
        assert opened.at().counts()["events"] == 0
        assert opened.merges() == []
        with pytest.raises(NoSuchThing, match="there is no place or object at all"):
            opened.why("run-a_p0")
