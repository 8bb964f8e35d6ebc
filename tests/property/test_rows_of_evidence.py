"""Estimates, classes, merges, missing and relocated Objects in rows: batches of any size and a
rebuild give what the deltas say."""

import json
from collections.abc import Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from projections.fold import deltas as d
from projections.fold.corrections import NO_CORRECTIONS, Corrections
from projections.fold.settings import Settings
from projections.map.changes import ChangeTracker
from projections.map.records import EstimatedPosition
from projections.map.view import MapView
from projections.postgres.graph_rows import object_rows
from projections.postgres.labels import COUNT_KEYS, LABELS, TABLE
from tests.support.memory_sink import MemorySink, MemoryTables
from tests.support.rows import memory_rows
from tests.support.synthetic_objects import (
    STEPS,
    Step,
    SyntheticDeltas,
    expected_rows,
    is_bare,
    random_steps,
    without_sigma,
)
from tests.support.thorough import examples, stride

EVIDENCE = Settings(fusion="evidence")
Events = Sequence[Sequence[d.Delta]]


def followed(
    events: Events,
    size: int,
    tables: MemoryTables,
    rules: Settings = EVIDENCE,
    corrections: Corrections = NO_CORRECTIONS,
) -> MapView:
    """A live sink's tables after batches of ``size``, each sent twice, as after a failed commit."""
    view = MapView(rules, keep_embeddings=False, corrections=corrections)
    tracker, sink = ChangeTracker(view), MemorySink()
    for start in range(0, len(events), size):
        for offset in range(start, min(start + size, len(events))):
            tracker.apply_event(d.Offset(offset), events[offset], offset)
        prepared = sink.prepare(tracker.drain(), tracker.view)
        prepared.send(tables)
        prepared.send(tables)
    return tracker.view


def rebuilt(
    events: Events,
    size: int,
    rules: Settings = EVIDENCE,
    corrections: Corrections = NO_CORRECTIONS,
) -> tuple[MapView, MemoryTables, dict[str, int]]:
    view = MapView(rules, keep_embeddings=False, corrections=corrections)
    tracker, tables = ChangeTracker(view), MemoryTables()
    shadow = MemorySink().shadow()
    shadow.create(tables)
    for offset, deltas in enumerate(events):
        tracker.apply_event(d.Offset(offset), deltas, offset)
        if offset % size == 0:
            shadow.load(tracker.drain(), tracker.view)(tables)
    shadow.load(tracker.drain(), tracker.view)(tables)
    rows = shadow.finish(tracker.view)(tables)
    shadow.swap_in(tables)
    return tracker.view, tables, dict(rows)


def check_rows(tables: MemoryTables, events: Events) -> None:
    by_label, rows = expected_rows(events), memory_rows(tables)
    for label in ("OBSERVES", "LOCATED_IN"):
        assert rows[label] == by_label[label]
    found, sigmas = without_sigma(rows["Object"])
    expected, expected_sigmas = without_sigma(by_label["Object"])
    assert found == expected
    assert sigmas == pytest.approx(expected_sigmas, rel=1e-12)


@settings(max_examples=examples(500))
@given(STEPS, st.integers(1, 30), st.integers(1, 30))
def test_batches_of_any_size_and_a_rebuild_give_what_the_deltas_say(
    steps: list[Step], size: int, rebuild_size: int
) -> None:
    events = SyntheticDeltas.of(steps).events
    live = MemoryTables()
    followed(events, size, live)
    check_rows(live, events)
    view, fresh, counted = rebuilt(events, rebuild_size)
    assert live.graph == fresh.graph
    assert live.vectors.keys() == fresh.vectors.keys()
    counts = view.counts()
    assert {label: counted[label] for label in LABELS} == {
        label: counts[COUNT_KEYS[label]] for label in LABELS
    }
    assert counted[TABLE] == sum(not is_bare(o.ordinal) for o in view.observations)
    assert live.vectors.keys() == {
        o.ordinal + 1 for o in view.observations if not is_bare(o.ordinal)
    }


@pytest.mark.parametrize("size", [1, 7, 1_000])
@pytest.mark.parametrize("seed", range(0, 5, stride(4)))
def test_longer_sequences_of_steps(seed: int, size: int) -> None:
    events, live = SyntheticDeltas.of(random_steps(seed, 80)).events, MemoryTables()
    followed(events, size, live)
    check_rows(live, events)
    assert live.graph == rebuilt(events, 10)[1].graph


def test_random_steps_give_every_kind_of_delta() -> None:
    """Else the tests here would say less than their names do."""
    kinds = {
        type(delta) for event in SyntheticDeltas.of(random_steps(1, 60)).events for delta in event
    }
    assert {
        d.ObjectsMerged, d.ObjectEstimated, d.ObjectClassified, d.ObjectMissing, d.ObjectRelocated
    } <= kinds  # fmt: skip


@settings(max_examples=examples(500))
@given(STEPS)
def test_rows_after_each_event_are_those_of_the_events_so_far(steps: list[Step]) -> None:
    events, tables = SyntheticDeltas.of(steps).events, MemoryTables()
    tracker = ChangeTracker(MapView(EVIDENCE, keep_embeddings=False))
    for offset, deltas in enumerate(events):
        tracker.apply_event(d.Offset(offset), deltas, offset)
        MemorySink().prepare(tracker.drain(), tracker.view).send(tables)
        check_rows(tables, events[: offset + 1])


@given(STEPS)
def test_the_rows_of_the_page_have_none_of_it(steps: list[Step]) -> None:
    events = SyntheticDeltas.of(steps).events
    view = MapView(Settings())
    for offset, deltas in enumerate(events):
        view.apply_event(d.Offset(offset), deltas)
    for _, properties in object_rows(view, view.objects):
        assert list(json.loads(properties)) == [
            "object_id", "class_name", "mean_x", "mean_y", "obs_count", "first_seen", "last_seen",
            "confirmed",
        ]  # fmt: skip


@given(STEPS)
def test_applying_events_twice_changes_no_object(steps: list[Step]) -> None:
    once, twice = MapView(EVIDENCE), MapView(EVIDENCE)
    for offset, deltas in enumerate(SyntheticDeltas.of(steps).events):
        once.apply_event(d.Offset(offset), deltas)
        twice.apply_event(d.Offset(offset), deltas)
        twice.apply_event(d.Offset(offset), deltas)
    assert once.objects.keys() == twice.objects.keys()
    for ordinal, found in once.objects.items():
        other = twice.objects[ordinal]
        fields = (
            "class_name", "obs_count", "observations", "estimate", "misses", "missing_in",
            "relocations", "place",
        )  # fmt: skip
        assert [getattr(found, f) for f in fields] == [getattr(other, f) for f in fields]


@pytest.mark.parametrize(
    ("variances", "sigma"),
    [
        ((0, 0, 0), 0.0),
        ((40_000_000_000, 0, 10_000_000_000), 0.2),
        ((10_000_000_000, 0, 40_000_000_000), 0.2),
        ((25_000_000_000, 15_000_000_000, 25_000_000_000), 0.2),
        ((25_000_000_000, -15_000_000_000, 25_000_000_000), 0.2),
    ],
)
def test_sigma_is_that_of_the_least_sure_direction(
    variances: tuple[int, int, int], sigma: float
) -> None:
    assert EstimatedPosition(1, 2, *variances, 3).est_sigma_m == pytest.approx(sigma, rel=1e-15)


def test_an_object_without_an_estimate_has_no_position() -> None:
    view = MapView(EVIDENCE)
    for offset, deltas in enumerate(SyntheticDeltas.of([Step(sees=(0,))]).events):
        view.apply_event(
            d.Offset(offset), [e for e in deltas if not isinstance(e, d.ObjectEstimated)]
        )
    ((_, properties),) = object_rows(view, [0])
    assert json.loads(properties)["missing"] is False
    assert "est_x" not in properties
