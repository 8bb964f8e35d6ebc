"""Maps folded by evidence: tails in batches of any size and rebuilds have the rows of the fold."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from eventsrc.envelope.commands import DifferentObjects, SameObject
from eventsrc.envelope.model import FIRST_OFFSET, Offset
from eventsrc.log import LogReader
from projections.fold import deltas as d
from projections.fold.semantic_map import SemanticMap
from projections.fold.settings import Settings
from projections.map.fold import fold_events, fold_log
from projections.map.parsing import read_corrections
from projections.map.view import MapView
from projections.postgres import rebuild, tail
from projections.postgres.check import check
from projections.postgres.connection import Targets
from projections.postgres.graph_rows import expected_rows
from projections.postgres.labels import LABELS
from projections.store.history_recorder import map_after
from tests.integration.test_projections import parsed
from tests.property.test_timeline_cache import kept_early
from tests.support.flickering_house import flickering_house
from tests.support.logs import append_command, command, forget_keyframes, undo, write_log
from tests.support.rows import all_rows, expected_graph, followed_and_rebuilt, graph_rows
from tests.support.thorough import mostly_slow, rounds

EVIDENCE = Settings(fusion="evidence")


@pytest.fixture(scope="module")
def documents() -> list[dict[str, Any]]:
    return flickering_house("a", rounds(240, 140)) + flickering_house("b", rounds(60, 40))


@pytest.fixture
def log(tmp_path: Path, documents: list[dict[str, Any]]) -> Path:
    return write_log(tmp_path / "log", documents)


def view_of(log: Path) -> MapView:
    with LogReader(log) as reader:
        return fold_log(reader, EVIDENCE, corrections=read_corrections(reader))[1]


def test_the_log_has_what_these_tests_are_about(log: Path) -> None:
    """Merges of Objects that earlier batches found, other classes, estimates."""
    fold = SemanticMap(EVIDENCE)
    kinds: Counter[type] = Counter()
    older, merged_later = 0, 0
    with LogReader(log) as reader:
        for event in fold_events(reader.read(FIRST_OFFSET), fold):
            kinds.update(map(type, event.deltas))
            found = [delta for delta in event.deltas if isinstance(delta, d.ObjectFound)]
            for delta in event.deltas:
                if isinstance(delta, d.ObjectsMerged):
                    assert delta.evidence is not None
                    merged_later += delta.absorbed < older
            older += len(found)
    assert kinds[d.ObjectEstimated] > kinds[d.ObjectFound] > 20
    assert kinds[d.ObjectClassified] > 3
    assert merged_later > 2


@pytest.mark.parametrize("size", mostly_slow([1, 17]))
def test_batches_of_any_size_give_the_rows_of_the_fold(log: Path, size: int) -> None:
    live, fresh = followed_and_rebuilt(log, EVIDENCE, size)
    assert live.graph == fresh.graph
    view = view_of(log)
    for label in LABELS:
        rows = [live.graph[label][key] for key in sorted(live.graph[label])]
        assert rows == list(expected_rows(view, label))


@pytest.mark.slow
@pytest.mark.parametrize("size", [23, 1, 256])
def test_a_tail_that_goes_on_has_the_rows_of_a_rebuild(
    tmp_path: Path,
    documents: list[dict[str, Any]],
    one_database: Targets,
    third_database: Targets,
    size: int,
) -> None:
    log = tmp_path / "log"
    for start in range(0, len(documents), 90):
        write_log(log, documents[start : start + 130])
        tail(log, one_database, EVIDENCE, once=True, batch_events=size)
    rebuild(log, third_database, EVIDENCE)
    rows = all_rows(one_database)
    assert rows == all_rows(third_database)
    view = view_of(log)
    assert parsed(dict(rows[0])) == expected_graph(view)
    assert len(view.objects) < len(view.all_objects)
    for report in check(log, one_database, EVIDENCE):
        assert (report.differing, report.foreign) == (0, ())


@pytest.mark.slow
def test_a_check_names_an_estimate_that_was_changed(
    log: Path, one_database: Targets, pg: Any
) -> None:
    rebuild(log, one_database, EVIDENCE)
    view = view_of(log)
    thing = next(o for o in view.objects.values() if o.estimate is not None)
    pg.execute(
        "SELECT * FROM cypher('semantic_map', $q$"
        f" MATCH (o:Object {{object_id: '{thing.object_id}'}}) SET o.est_x = 0.25, o.missing = true"
        " $q$) AS (o agtype)"
    )
    graph, vectors = check(log, one_database, EVIDENCE)
    assert vectors.sound
    (difference,) = graph.differences
    assert (difference.table, difference.kind) == ("Object", "different")
    assert "'est_x': 'float 0.25'" in str(difference.found)


def test_a_tail_starts_from_a_kept_fold(log: Path, one_database: Targets) -> None:
    with kept_early():
        with LogReader(log) as reader:
            map_after(reader, EVIDENCE, Offset(100))
        rebuild(log, one_database, EVIDENCE, until=Offset(120))
        folded: list[int] = []
        tail(log, one_database, EVIDENCE, once=True, on_fold=folded.append)
    assert folded[0] == 100
    assert parsed(graph_rows(one_database.graph_url)) == expected_graph(view_of(log))


@pytest.mark.slow
def test_commands_about_objects_are_obeyed_by_tails(
    tmp_path: Path,
    documents: list[dict[str, Any]],
    one_database: Targets,
    third_database: Targets,
) -> None:
    log = write_log(tmp_path / "log", documents[:160])

    def agree() -> MapView:
        tail(log, one_database, EVIDENCE, once=True, batch_events=40)
        rebuild(log, third_database, EVIDENCE)
        rows, view = all_rows(one_database), view_of(log)
        assert rows == all_rows(third_database)
        assert parsed(dict(rows[0])) == expected_graph(view)
        return view

    view = agree()
    first, second = sorted(view.objects.values(), key=lambda o: -o.obs_count)[:2]
    det_ids = tuple(view.observations[o.observations[0]].det_id for o in (first, second))
    given = command(SameObject, det_ids=det_ids)
    append_command(log, given)
    one = agree()
    objects = {o.object for o in one.observations if o.det_id in det_ids}
    assert len(objects) == 1
    append_command(log, undo(given))
    absorbed = next(o for o in view.all_objects if o.ordinal not in view.objects)
    kept = view.objects[view.object_survivors.find(absorbed.ordinal)]
    apart = (
        view.observations[kept.observations[0]].det_id,
        founder_of(log, absorbed.ordinal, view),
    )
    append_command(log, command(DifferentObjects, det_ids=apart))
    two = agree()
    assert len({o.object for o in two.observations if o.det_id in apart}) == 2
    append_command(log, forget_keyframes(10, 40, run_id="sim-7-a"))
    agree()


def founder_of(log: Path, ordinal: int, view: MapView) -> str:
    """The det_id that founded an Object, absorbed ones too."""
    with LogReader(log) as reader:
        for event in fold_events(reader.read(FIRST_OFFSET), SemanticMap(EVIDENCE)):
            for delta in event.deltas:
                if isinstance(delta, d.ObjectFound) and delta.object == ordinal:
                    return view.observations[delta.observation].det_id
    raise AssertionError(ordinal)


@pytest.mark.slow
def test_what_was_carried_away_is_missing_in_the_graph(
    tmp_path: Path, one_database: Targets, third_database: Targets
) -> None:
    gone = ("lamp", "couch", "bed", "potted plant")
    log = tmp_path / "log"
    write_log(log, flickering_house("a", 445, noise_m=0.05))
    tail(log, one_database, EVIDENCE, once=True)
    before = [json.loads(row[1]) for row in graph_rows(one_database.graph_url)["Object"]]
    assert not any(thing["missing"] for thing in before)
    write_log(log, flickering_house("c", 324, noise_m=0.05, without=gone))
    tail(log, one_database, EVIDENCE, once=True, batch_events=40)
    after = [json.loads(row[1]) for row in graph_rows(one_database.graph_url)["Object"]]
    missing = [thing["class_name"] for thing in after if thing["missing"]]
    assert sum(class_name in gone for class_name in missing) >= 4
    assert sum(class_name not in gone for class_name in missing) <= 2
    rebuild(log, third_database, EVIDENCE)
    rows = all_rows(one_database)
    assert rows == all_rows(third_database)
    assert parsed(dict(rows[0])) == expected_graph(view_of(log))
    assert all(report.sound for report in check(log, one_database, EVIDENCE))
