"""What `why`, `merges --objects` and `diff` say of an object under fusion by evidence."""

import math
from collections.abc import Sequence
from itertools import pairwise

import pytest

from eventsrc.envelope.model import Offset
from projections.fold import deltas as d
from projections.fold.settings import Settings
from projections.history.diff import difference_of
from projections.history.diff_rendering import difference_text
from projections.history.explanation import Explanation
from projections.history.merge_reasons import object_merge_document
from projections.history.object_explanation import explain_object
from projections.history.rendering import explanation_text, object_merges_text
from projections.map.view import MapView
from tests.support.memory_history import MemoryHistory

EVIDENCE = Settings(fusion="evidence")


_LOOKING_THERE = {
    4: d.Pose(0, 0, math.atan2(2.0, 1.2)),
    5: d.Pose(2_000_000, 0, math.atan2(2.0, -0.8)),
}
"""Poses that look from two sides at where the thing was."""


def _keyframe(n: int, *seen: tuple[int, str]) -> list[d.Delta]:
    """The keyframe of event n, in run n // 4; its observations have their offset's number ×10."""
    run = d.RunOrdinal(n // 4)
    deltas: list[d.Delta] = []
    if n % 4 == 0:
        deltas.append(d.RunSeen(Offset(n), run, f"run-{run}", 100.0 + n))
    pose = _LOOKING_THERE.get(n) or d.Pose(1_000_000 * n, 0, 0.0)
    deltas.append(
        d.KeyframeAdded(Offset(n), d.KeyframeOrdinal(n), run, f"run-{run}", n % 4, 100.0 + n, pose)
    )
    for observation, class_name in seen:
        deltas.append(
            d.ObservationAdded(
                Offset(n), observation, n, f"run-{run}", n % 4, f"det-{observation}", class_name,
                0.5, (1.0, 2.0, 3.0, 4.0), None, None, False,
            )
        )  # fmt: skip
    return deltas


def _seen(n: int, thing: int, observation: int, count: int, halves: int = 1) -> d.Delta:
    return d.ObjectSeen(Offset(n), thing, observation, halves << 39, count, 0, 0, 100.0, 100.0 + n)


def _at(n: int, thing: int, x_um: int, sigma_um: int, spots: int) -> d.Delta:
    variance = sigma_um**2
    return d.ObjectEstimated(Offset(n), thing, x_um, 2_000_000, variance, 0, variance // 4, spots)


BECAUSE = "0.34 m apart, looks +3.2, positions -0.1, in one picture 0 of 12 times"
MERGE = d.MergeEvidence(3_200, -150, 340_000, 0, 12)
EVENTS: list[list[d.Delta]] = [
    [
        *_keyframe(0, (0, "chair")),
        d.ObjectFound(Offset(0), 0, "obj-a", "chair", 0),
        _seen(0, 0, 0, 1, 2),
        _at(0, 0, 1_000_000, 800_000, 1),
    ],
    [
        *_keyframe(1, (1, "stool")),
        d.ObjectFound(Offset(1), 1, "obj-b", "stool", 1),
        _seen(1, 1, 1, 1, 2),
        _at(1, 1, 1_340_000, 900_000, 1),
    ],
    [
        *_keyframe(2, (2, "stool")),
        _seen(2, 0, 2, 2),
        d.ObjectsMerged(Offset(2), 0, 1, 3, 3_000_000, 0, 100.0, 102.0, MERGE),
        d.ObjectClassified(Offset(2), 0, "stool"),
        _at(2, 0, 1_200_000, 120_000, 3),
    ],
    [*_keyframe(3), d.ObjectMissing(Offset(3), 0, 0, 1, False)],
    [*_keyframe(4), d.ObjectMissing(Offset(4), 0, 1, 4, True)],
    [*_keyframe(5), d.ObjectMissing(Offset(5), 0, 1, 5, True)],
    [
        *_keyframe(6, (3, "stool")),
        _seen(6, 0, 3, 4),
        d.ObjectRelocated(Offset(6), 0, 3, 1_200_000, 2_000_000, 4_200_000, 6_000_000),
        _at(6, 0, 4_200_000, 300_000, 1),
    ],
    [*_keyframe(7), d.ObjectMissing(Offset(7), 0, 1, 3, True)],
    [
        *_keyframe(8, (4, "stool")),
        _seen(8, 0, 4, 5),
        d.ObjectMissing(Offset(8), 0, 2, 0, False),
        _at(8, 0, 4_200_000, 250_000, 2),
    ],
]


def told(events: Sequence[Sequence[d.Delta]]) -> tuple[MemoryHistory, MapView]:
    history, view = MemoryHistory(EVIDENCE), MapView(EVIDENCE)
    for offset, deltas in enumerate(events):
        history.apply(Offset(offset), deltas)
        view.apply_event(Offset(offset), deltas)
    return history, view


def why(thing: int, end: int) -> Explanation:
    history, view = told(EVENTS)
    return explain_object(
        history, view.observations.__getitem__, history.objects[thing], Offset(end)
    )


def test_why_tells_the_story_of_an_object() -> None:
    text = explanation_text(why(0, len(EVENTS)))
    assert [line.split("  ", 3)[-1] for line in text.splitlines()[1:]] == [
        "new object: det-0, seen from (0.00, 0.00), matched no object nearby",
        "stands at (1.00, 2.00) ± 0.80 m, seen from 1 spot",
        f"obj-b was fused into it as one thing: {BECAUSE}",
        "stands at (1.20, 2.00) ± 0.12 m, seen from 3 spots",
        "called stool instead of chair: most sightings say so",
        "missing: not seen in 4 keyframes that should show it",
        "moved 5.00 m, from (1.20, 2.00) to (4.20, 6.00)",
        "missing: not seen in 3 keyframes that should show it",
        "seen where it was missing",
    ]
    assert text.splitlines()[0].startswith(
        "object obj-a: stool (stool ×4, chair ×1), seen 5 times (similarity at least 0.50), "
    )
    assert text.splitlines()[0].endswith("; stands at (4.20, 2.00) ± 0.25 m, seen from 2 spots")


MISSED = "not seen in {} keyframes that should show it"


@pytest.mark.parametrize(
    ("end", "says"),
    [
        (3, "± 0.12 m, seen from 3 spots"),
        (4, "± 0.12 m, seen from 3 spots"),
        (
            5,
            f"; missing since offset 4 (run-1:0, 1970-01-01T00:01:44.000Z): {MISSED.format(4)}",
        ),
        (
            6,
            f"; missing since offset 4 (run-1:0, 1970-01-01T00:01:44.000Z): {MISSED.format(5)}",
        ),
        (7, "± 0.30 m, seen from 1 spot"),
        (
            8,
            f"; missing since offset 7 (run-1:3, 1970-01-01T00:01:47.000Z): {MISSED.format(3)}",
        ),
        (9, "± 0.25 m, seen from 2 spots"),
    ],
)
def test_why_says_since_when_it_is_missing(end: int, says: str) -> None:
    assert why(0, end).summary.endswith(says)


def test_why_gives_the_same_as_json() -> None:
    document = why(0, 6).document()
    assert document["class_name"] == "stool"
    assert document["class_counts"] == {"stool": 2, "chair": 1}
    assert document["estimate"] == {"x": 1.2, "y": 2.0, "sigma_m": 0.12, "spots": 3}
    assert (document["missing"], document["misses"]) == (True, 5)
    (fused,) = (e for e in document["entries"] if e["what"] == "fused")
    assert fused["evidence"] == {
        "distance_m": 0.34,
        "look": 3.2,
        "geometry": -0.15,
        "pictures_with_both": 0,
        "pictures": 12,
    }
    (moved,) = (e for e in why(0, 9).document()["entries"] if e["what"] == "moved")
    assert (moved["from"], moved["to"]) == ([1.2, 2.0], [4.2, 6.0])


def test_why_of_an_absorbed_object_says_with_what_and_why() -> None:
    found = why(1, 9)
    assert found.summary.startswith("fused into obj-a at offset 2")
    assert found.entries[-1].text.startswith("fused into obj-a as one thing: 0.34 m apart")


def test_merges_of_objects_say_why() -> None:
    history, _ = told(EVENTS)
    text = object_merges_text(history, history.object_merges)
    header, row = text.splitlines()
    assert header.endswith("because")
    assert row.endswith(f"stool  {BECAUSE}")
    document = object_merge_document(history, history.object_merges[0])
    assert document["class_name"] == "stool"
    assert document["evidence"]["pictures"] == 12


def test_a_difference_names_what_evidence_changed() -> None:
    views = [told(EVENTS[:end])[1] for end in (2, 4, 6, 9)]
    texts = [difference_text(difference_of(a, b, {}, ()), most=None) for a, b in pairwise(views)]
    assert "chair → stool, seen 1 → 3 times" in texts[0]
    assert "± 0.80 → 0.12 m" in texts[0]
    assert "- obj-b stool: joined into obj-a\n" in texts[0]
    assert "1 other shifted by less than its error\n" in texts[0]
    assert "! obj-a stool: missing at (1.20, 2.00), no place\n" in texts[1]
    assert "> obj-a stool: moved 3.00 ± 0.28 m, (1.20, 2.00) → (4.20, 2.00)\n" in texts[2]
    assert "! obj-a stool: back at (1.20, 2.00), no place\n" in texts[2]
    after = difference_of(views[1], views[2], {}, ()).document()["objects"]["changed"][0]["after"]
    assert (after["est_x"], after["missing"], after["spots"]) == (1.2, True, 3)
