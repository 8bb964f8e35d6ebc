"""Deltas of fusion by evidence in the databases: live batches and a rebuild give what they say."""

import contextlib
import json
import math
import re
from collections.abc import Iterator
from pathlib import Path

import psycopg
import pytest

from projections.fold import deltas as d
from projections.fold.settings import Settings
from projections.map.changes import ChangeTracker
from projections.map.records import ObjectRecord
from projections.map.view import MapView
from projections.postgres.checkpoints import ensure_schema
from projections.postgres.connection import Connection, Targets, connect, pin_session_settings
from projections.postgres.graph_sink import GraphSink
from projections.postgres.queries.candidate_search import prepare_graph
from projections.postgres.queries.graph_reads import objects_near
from projections.postgres.queries.live_view import read_view
from projections.postgres.vector_sink import VectorSink
from tests.integration.test_projections import parsed
from tests.support.memory_sink import MemorySink, MemoryTables
from tests.support.rows import all_rows, expected_graph
from tests.support.synthetic_objects import (
    SyntheticDeltas,
    expected_rows,
    random_steps,
    without_sigma,
)
from tests.support.thorough import mostly_slow

EVIDENCE = Settings(fusion="evidence")
PAGE = Path(__file__).parents[2] / "docs" / "projections.md"


@contextlib.contextmanager
def session(targets: Targets) -> Iterator[Connection]:
    with connect(targets.graph_url, autocommit=True) as connection:
        pin_session_settings(connection)
        ensure_schema(connection)
        yield connection


def follow(connection: Connection, events: list[list[d.Delta]], size: int) -> MapView:
    """Both sinks live, in batches of ``size``."""
    tracker = ChangeTracker(MapView(EVIDENCE, keep_embeddings=False))
    sinks = GraphSink(), VectorSink(dimension=3)
    with connection.transaction():
        for sink in sinks:
            sink.ensure(connection)
    for start in range(0, len(events), size):
        for offset in range(start, min(start + size, len(events))):
            tracker.apply_event(d.Offset(offset), events[offset], offset * 1_000)
        changes = tracker.drain()
        writes = [sink.prepare(changes, tracker.view) for sink in sinks]
        is_small = all(write.is_small for write in writes)
        with (
            connection.pipeline() if is_small else contextlib.nullcontext(),
            connection.transaction(),
        ):
            for write in writes:
                write.send(connection)
    return tracker.view


def rebuild(connection: Connection, events: list[list[d.Delta]], size: int) -> MapView:
    tracker = ChangeTracker(MapView(EVIDENCE, keep_embeddings=False))
    shadows = GraphSink().shadow(), VectorSink(dimension=3).shadow()
    with connection.transaction():
        for shadow in shadows:
            shadow.create(connection)
        for offset, deltas in enumerate(events):
            tracker.apply_event(d.Offset(offset), deltas, offset * 1_000)
            if offset % size == 0 or offset + 1 == len(events):
                changes = tracker.drain()
                for shadow in shadows:
                    shadow.load(changes, tracker.view)(connection)
        for shadow in shadows:
            shadow.finish(tracker.view)(connection)
        for shadow in shadows:
            shadow.lock_readers(connection)
            shadow.swap_in(connection)
    return tracker.view


@pytest.mark.parametrize(
    ("seed", "size"),
    mostly_slow([(1, 1), (2, 7), (3, 7), (4, 99)]),
)
def test_live_batches_and_a_rebuild_give_what_the_deltas_say(
    seed: int, size: int, one_database: Targets
) -> None:
    events = SyntheticDeltas.of(random_steps(seed, 70)).events
    with session(one_database) as connection:
        view = follow(connection, events, size)
        assert len(view.objects) < len(view.all_objects)
        live = all_rows(one_database)
        rebuild(connection, events, 13)
        assert all_rows(one_database) == live
    graph = parsed(dict(live[0]))
    assert graph == expected_graph(view)
    by_label = expected_rows(events)
    assert {label: graph[label] for label in ("OBSERVES", "LOCATED_IN")} == {
        label: by_label[label] for label in ("OBSERVES", "LOCATED_IN")
    }
    found, sigmas = without_sigma(graph["Object"])
    expected, expected_sigmas = without_sigma(by_label["Object"])
    assert found == expected
    assert sigmas == pytest.approx(expected_sigmas, rel=1e-12)
    memory, tracker = MemoryTables(), ChangeTracker(MapView(EVIDENCE, keep_embeddings=False))
    for offset, deltas in enumerate(events):
        tracker.apply_event(d.Offset(offset), deltas, offset * 1_000)
        MemorySink().prepare(tracker.drain(), tracker.view).send(memory)
    assert [row[0] for row in live[1]] == sorted(memory.vectors)
    assert [row[2] for row in live[1]] == [
        row.added.det_id for _, row in sorted(memory.vectors.items())
    ]


def test_the_example_of_the_page_finds_objects_by_where_they_stand(
    one_database: Targets, pg: psycopg.Connection
) -> None:
    (query,) = re.findall(r"    SELECT[^;]*o\.est_sigma_m < 0\.5[^;]*;", PAGE.read_text())
    with session(one_database) as connection:
        view = follow(connection, SyntheticDeltas.of(random_steps(10, 30)).events, 10)
    rows = pg.execute(query.encode()).fetchall()
    near = [
        o for o in view.objects.values()
        if o.estimate is not None and math.dist(stands_at(o), (3.0, 1.0)) < 2.0
    ]  # fmt: skip
    found = [o for o in near if o.missing_in is None]
    assert sorted(json.loads(row[0]) for row in rows) == sorted(o.object_id for o in found)
    assert {(json.loads(row[0]), float(row[2]), float(row[3])) for row in rows} == {
        (o.object_id, *stands_at(o)) for o in found
    }
    assert 0 < len(found) < len(near) < len(view.objects)


def test_questions_use_where_objects_stand(one_database: Targets) -> None:
    events = SyntheticDeltas.of(random_steps(6, 70)).events
    # One has no estimate: its mean position counts.
    events = [
        [e for e in deltas if not (isinstance(e, d.ObjectEstimated) and e.object == 0)]
        for deltas in events
    ]
    with session(one_database) as connection:
        view = follow(connection, events, 10)
        prepare_graph(connection)
        live = {each.object_id: each for each in read_view(connection).objects.values()}
        assert [*live] == [each.object_id for each in view.objects.values()]
        for thing in view.objects.values():
            found = live[thing.object_id]
            assert (found.estimate, found.spot) == (thing.estimate, thing.spot)
            assert (found.missing_in is None) == (thing.missing_in is None)
            x, y = found.spot
            (nearest, *_) = objects_near(connection, x, y, 0.5)
            assert nearest["distance_m"] == 0.0
        for radius in (1.0, 3.0):
            near = {
                o.object_id: pytest.approx(distance)
                for o in view.objects.values()
                if (distance := math.dist(stands_at(o), (x, y))) <= radius
            }
            found_near = objects_near(connection, x, y, radius)
            assert {o["object_id"]: o["distance_m"] for o in found_near} == near
            assert found_near == sorted(found_near, key=lambda o: o["distance_m"])
        assert 1 < len(near) < len(view.objects)


def stands_at(thing: ObjectRecord) -> tuple[float, float]:
    at = thing.estimate
    return (thing.mean_x, thing.mean_y) if at is None else (at.est_x, at.est_y)
