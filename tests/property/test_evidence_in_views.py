"""Views, histories and digests of fusion by evidence, from deltas made by hand.

The oracle of each is a view to which the same deltas were applied one by one.
"""

import dataclasses
import json
from collections import Counter
from collections.abc import Callable, Sequence
from itertools import pairwise

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from eventsrc.envelope.model import Offset
from projections.fold import deltas as d
from projections.fold.settings import Settings
from projections.history.condition_functions import CountIndex, HistoryFacts
from projections.history.diff import difference_of, rows_of
from projections.map.digest import map_digest
from projections.map.records import EstimatedPosition, ObjectRecord, Relocation
from projections.map.state_output import state_document, state_text
from projections.map.view import MapView
from tests.support.histories import view_at
from tests.support.memory_history import MemoryHistory
from tests.support.synthetic_objects import STEPS, Step, SyntheticDeltas, random_steps

EVIDENCE = Settings(fusion="evidence")
SLOW = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])


def view_of(events: Sequence[Sequence[d.Delta]], rules: Settings = EVIDENCE) -> MapView:
    view = MapView(rules, keep_embeddings=False)
    for offset, deltas in enumerate(events):
        view.apply_event(Offset(offset), deltas)
    return view


def history_of(events: Sequence[Sequence[d.Delta]]) -> MemoryHistory:
    history = MemoryHistory(EVIDENCE)
    for offset, deltas in enumerate(events):
        history.apply(Offset(offset), deltas)
    return history


@SLOW
@given(STEPS)
def test_a_map_at_any_offset_is_that_of_the_deltas_before_it(steps: list[Step]) -> None:
    events = SyntheticDeltas.of(steps).events
    history, latest = history_of(events), view_of(events)
    for end in range(len(events) + 1):
        past, expected = view_at(history, latest, Offset(end)), view_of(events[:end])
        assert map_digest(past) == map_digest(expected)
        assert state_document(past, "") == state_document(expected, "")
        assert rows_of(past) == rows_of(expected)


@SLOW
@given(STEPS)
def test_a_delta_applied_twice_does_no_harm(steps: list[Step]) -> None:
    events = SyntheticDeltas.of(steps).events
    assert map_digest(
        view_of([[delta for delta in deltas for _ in (1, 2)] for deltas in events])
    ) == map_digest(view_of(events))


@SLOW
@given(STEPS, st.data())
def test_the_difference_of_two_maps_turns_one_into_the_other(
    steps: list[Step], data: st.DataObject
) -> None:
    events = SyntheticDeltas.of(steps).events
    first, second = sorted(data.draw(st.integers(0, len(events))) for _ in "ab")
    before, after = view_of(events[:first]), view_of(events[:second])
    difference = difference_of(before, after, {}, ())
    assert difference.apply(rows_of(before)) == rows_of(after)
    json.dumps(difference.document(), allow_nan=False)


@SLOW
@given(STEPS)
def test_objects_of_a_class_are_counted_as_they_are_called_at_each_offset(
    steps: list[Step],
) -> None:
    events = SyntheticDeltas.of(steps).events
    history = history_of(events)
    index = CountIndex(history)
    counts = []
    for end in range(len(events) + 1):
        facts = HistoryFacts(history, index, Offset(end))
        objects = view_of(events[:end]).objects.values()
        expected = Counter(o.class_name for o in objects)
        assert facts.object_count() == len(objects)
        for name in {o.found.class_name for o in history.objects} | expected.keys():
            assert facts.object_count(name) == expected[name]
        counts.append(expected)
    falls = any(b[name] < a[name] for a, b in pairwise(counts) for name in a)
    assert not falls or HistoryFacts(history, index, Offset(len(events))).objects_merge


ESTIMATE = EstimatedPosition(1, 2, 30, 4, 50, 3)


@pytest.mark.parametrize(
    "change",
    [
        *(
            lambda o, name=field.name: setattr(
                o,
                "estimate",
                dataclasses.replace(ESTIMATE, **{name: getattr(ESTIMATE, name) + 1}),
            )
            for field in dataclasses.fields(EstimatedPosition)
        ),
        lambda o: setattr(o, "estimate", None),
        lambda o: setattr(o, "misses", 7),
        lambda o: setattr(o, "missing_in", 0),
        lambda o: setattr(o, "class_name", "sofa"),
        lambda o: o.relocations.append(Relocation(Offset(3), d.ObservationOrdinal(1), 0, 0, 1, 1)),
    ],
)
def test_the_digest_of_fusion_by_evidence_covers_each_value(
    change: Callable[[ObjectRecord], None],
) -> None:
    digests = []
    for changed in (False, True):
        view = view_of(SyntheticDeltas.of([Step(sees=(0,)), Step(sees=(0,))]).events)
        found = view.objects[d.ObjectOrdinal(0)]
        found.estimate = ESTIMATE
        if changed:
            change(found)
        digests.append(map_digest(view))
    assert digests[0] != digests[1]


def test_the_digest_of_the_page_s_rule_has_no_section_for_evidence() -> None:
    events = SyntheticDeltas.of([Step(sees=(0, 1)), Step(sees=(0,), place=1)]).events
    plain = [[x for x in each if not isinstance(x, d.ObjectEstimated)] for each in events]
    assert map_digest(view_of(events, Settings())) == map_digest(view_of(plain, Settings()))
    assert map_digest(view_of(events)) != map_digest(view_of(plain))
    (row, *_) = state_document(view_of(plain, Settings()), "")["objects"]
    assert not {"est_x", "missing", "class_counts", "spots"} & row.keys()


def test_state_says_where_things_stand() -> None:
    view = view_of(SyntheticDeltas.of(random_steps(3, 120)).events)
    document = state_document(view, "d")
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    assert any(row["missing"] for row in document["objects"])
    assert any(row["relocations"] for row in document["objects"])
    for row, found in zip(document["objects"], view.objects.values(), strict=True):
        names = [view.observations[i].class_name for i in found.observations]
        assert row["class_counts"] == Counter(names)
        counts = list(row["class_counts"].values())
        assert counts == sorted(counts, reverse=True)
        assert found.estimate is not None
        assert row["est_x"] == found.estimate.x_um / 1e6
        assert row["spots"] == found.estimate.spots
        assert row["missing"] is (found.missing_in is not None)
    text = state_text(view, "d")
    (line,) = (x for x in text.splitlines() if x.startswith("objects  "))
    missing = sum(row["missing"] for row in document["objects"])
    moved = sum(bool(row["relocations"]) for row in document["objects"])
    assert line.endswith(f", {missing} missing, {moved} moved")
    once = sum(row["spots"] < 2 for row in document["objects"])
    assert f", {once} from one" in line
