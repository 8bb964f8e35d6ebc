"""Time travel over places by rooms: why they were founded and merged, and refusals."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from eventsrc.envelope.commands import Command, Join, KeepApart
from projections.adapters.drawing.merge_picture import draw_merge
from projections.fold.settings import Settings
from projections.history import LogTimeline
from projections.history.merge_reasons import (
    chains_of,
    merge_document,
    merge_reason,
    refusal_document,
)
from projections.history.rendering import merge_text, merges_text, refusals_text
from tests.support.envelopes import detection, envelope
from tests.support.walks import anchor, write_mixed_log

RULES = Settings(places="rooms")
SAID: dict[str, Any] = {"issued_by": "ann@lab", "reason": "a door"}
U_TURN = [(0, 0), (1, 0), (2, 0), (3, 0), (4, 0), (4, 1), (3, 1), (2, 1), (1, 1), (0, 1), (0, 0)]
"""A cell each. Eight are of the first place; the ninth is 8, 7 … 1 m of driving from them, a mean
of 4.5 m, so it founds the second. The last step is a short cut between the two ends."""
BACK = 10
"""The keyframe of that step."""

Open = Callable[..., LogTimeline]


def u_turn(things: dict[int, str] | None = None) -> list[dict[str, Any]]:
    seen = {k: [detection(name, [1.0, 0.0])] for k, name in (things or {}).items()}
    return [
        envelope(k, float(x), float(y), detections=seen.get(k, []))
        for k, (x, y) in enumerate(U_TURN)
    ]


@pytest.fixture
def opened(tmp_path: Path) -> Iterator[Open]:
    made: list[LogTimeline] = []

    def open_with(documents: list[dict[str, Any]], *commands: Command) -> LogTimeline:
        made.append(LogTimeline(write_mixed_log(tmp_path / "log", [*documents, *commands]), RULES))
        return made[-1]

    yield open_with
    for timeline in made:
        timeline.reader.close()


def test_a_place_is_founded_where_the_drive_from_all_others_is_long(opened: Open) -> None:
    timeline = opened(u_turn()[:9])
    assert [e.text for e in timeline.why("run-a_p1").entries] == [
        "founded: run-a:8 at (1.00, 1.00) was a long drive from every place; members run-a:8"
    ]


def test_a_merge_tells_the_mean_drive_and_what_both_saw(opened: Open) -> None:
    timeline = opened(u_turn({2: "couch", 9: "couch", 4: "sink"}))
    (merge,) = timeline.merges()
    history = timeline.history
    (couch,) = {o.object_id for o in history.objects if o.found.class_name == "couch"}
    assert chains_of(history, merge) == []
    assert merge_reason(history, merge) == (
        "run-a:10 brought them near: 8 cells of run-a_p0 and 2 of run-a_p1 are a drive of 3.000 m "
        "apart on the mean, at most 4 m joins them; nearest are those of run-a:0 and run-a:9, "
        f"1.000 m; both saw couch {couch}"
    )
    assert merge_reason(history, merge) in merge_text(history, merge)
    document = merge_document(history, merge)
    assert document["links"] == [
        {"core": "run-a:0", "neighbour": "run-a:9", "distance_m": 1.0},
    ]
    assert document["drives"] == [
        {"mean_m": 3.0, "limit_m": 4.0, "cells": 8, "absorbed_cells": 2},
    ]
    assert document["seen_from_both"] == [couch]


def test_of_many_things_that_both_saw_three_are_named(opened: Open) -> None:
    documents = u_turn()
    for at in (2, 9):
        documents[at]["detections"] = [
            detection(f"thing {n}", [float(n == i) for i in range(6)]) for n in range(6)
        ]
    timeline = opened(documents)
    (merge,) = timeline.merges()
    reason = merge_reason(timeline.history, merge)
    assert reason.count("thing") == 3
    assert reason.endswith(" and 3 more")
    assert len(merge_document(timeline.history, merge)["seen_from_both"]) == 6
    assert merge_text(timeline.history, merge).count("(thing") == 0
    alone = merge_text(timeline.history, merge).splitlines()[1]
    assert alone.startswith("because ")
    assert alone.count("thing") == 6, "--show names all"


def test_the_table_has_the_reason_of_each_merge(opened: Open) -> None:
    timeline = opened(u_turn({2: "couch", 9: "couch"}))
    (merge,) = timeline.merges()
    header, row = merges_text(timeline.history, [merge], BACK + 1).splitlines()
    assert header.split()[-1] == "because"
    assert row.endswith(merge_reason(timeline.history, merge))


def test_what_is_seen_only_later_or_from_one_place_is_not_told(opened: Open) -> None:
    seen_later = envelope(11, 0.0, 1.0, detections=[detection("sink", [1.0, 0.0])])
    timeline = opened([*u_turn({4: "sink", 9: "lamp"}), seen_later])
    (merge,) = timeline.merges()
    assert "both saw" not in merge_reason(timeline.history, merge)


def test_a_merge_is_drawn_with_its_two_nearest_cells(opened: Open, tmp_path: Path) -> None:
    timeline = opened(u_turn())
    (merge,) = timeline.merges()
    draw_merge(timeline.knowing(), merge, tmp_path / "merge.png")
    assert (tmp_path / "merge.png").stat().st_size > 10_000


def test_why_two_keyframes_are_in_one_place(opened: Open) -> None:
    story = opened(u_turn()).why_same("run-a:0", "run-a:9")
    assert (story.facts["same"], story.facts["since"]) == (True, BACK)
    assert "are a drive of 3.000 m apart on the mean" in story.entries[-1].text


def test_a_refusal_tells_the_drive_between_the_cells(opened: Open) -> None:
    apart = KeepApart(command_id="c1", places=(anchor("run-a", 0), anchor("run-a", 8)), **SAID)
    timeline = opened(u_turn(), apart)
    known = timeline.knowing()
    (refusal,) = known.refusals()
    assert len(timeline.at(known.end).places) == 2
    assert refusal_document(known.history, refusal)["apart"] == ["run-a:0", "run-a:8"]
    near = "the cells of run-a:0 and run-a:9 are a drive of 1.000 m apart"
    assert "1.000 m  keep-apart c1" in refusals_text(known.history, [refusal])
    assert near in timeline.why("run-a_p0").entries[-2].text


def test_a_join_is_told_by_its_command(opened: Open) -> None:
    join = Join(command_id="c2", places=(anchor("run-a", 0), anchor("run-a", 8)), **SAID)
    timeline = opened(u_turn()[:9], join)
    (merge,) = timeline.merges()
    reason = merge_reason(timeline.knowing().history, merge)
    assert reason == "run-a:0 and run-a:8, 1.414 m apart, joined by join c2 (ann@lab: a door)"


def test_apart_in_one_cell_are_parted(opened: Open) -> None:
    """A keyframe that is kept apart from its cell's place has a cell of its own."""
    documents = [envelope(k, 0.1 * k, 0.0) for k in range(4)]
    apart = KeepApart(command_id="c1", places=(anchor("run-a", 1), anchor("run-a", 3)), **SAID)
    timeline = opened(documents, apart)
    view = timeline.at(timeline.end)
    assert [k.place for k in view.keyframes] == [0, 0, 0, 1]
