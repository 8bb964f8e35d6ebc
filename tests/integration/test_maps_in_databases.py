"""A log with an occupancy map in the databases: tail, rebuild and check agree, under both rules of
places; what is no map is parked like any event that cannot be folded."""

import random
from dataclasses import replace
from pathlib import Path
from typing import Any, LiteralString

import numpy as np
import psycopg
import pytest

from eventsrc.envelope.model import Offset
from eventsrc.envelope.occupancy_map import OccupancyMap
from eventsrc.envelope.system_events import MAP_KEY
from eventsrc.log import LogReader, LogWriter
from projections.fold.map_errors import DatabaseError
from projections.fold.settings import Settings
from projections.localize.relocalize import MapCandidates, QuestionCrop
from projections.map.fold import fold_log
from projections.map.place_regions import place_regions
from projections.postgres import rebuild, tail
from projections.postgres.check import check
from projections.postgres.connection import Targets
from projections.postgres.queries.candidate_search import CandidateReader
from tests.support.commands import Commands
from tests.support.envelopes import envelope, payload
from tests.support.fixtures_log import KEY
from tests.support.maps import drawn_map
from tests.support.rows import all_rows, followed_and_rebuilt, map_rows
from tests.support.thorough import every_other, mostly_slow, rounds, stride

ROOMS = drawn_map("########## #...#....# #...#....# #........# ##########", 1.0, (-2.0, -2.0, 0.0))
EAST = [envelope(k, 4.0 - 0.25 * (k % 4), 0.0) for k in range(8)]
WEST = [envelope(k, 1.7 - 0.25 * (k % 4), 0.0) for k in range(8, 16)]


def _log(path: Path, content: bytes) -> Path:
    with LogWriter(path) as writer:
        writer.append(MAP_KEY, content)
        for document in [*EAST, *WEST]:
            writer.append(KEY, payload(document))
    return path


@pytest.mark.parametrize("places", mostly_slow(["rooms", "page"]))
def test_tail_rebuild_and_check_agree(tmp_path: Path, one_database: Targets, places: str) -> None:
    log = _log(tmp_path / "log", ROOMS.encode())
    settings = Settings.model_validate({"places": places})
    assert tail(log, one_database, settings, once=True).next_offset == 17
    tailed = all_rows(one_database)
    with LogReader(log) as reader:
        view = fold_log(reader, settings)[1]
    assert len(view.places) == 2
    rebuild(log, one_database, settings)
    assert all_rows(one_database) == tailed
    assert [r.differing for r in check(log, one_database, settings)] == [0, 0]


def test_a_region_that_a_later_map_takes_away_goes_from_the_rows(
    tmp_path: Path, one_database: Targets
) -> None:
    """Also where a tail was started in between, which has not written the region itself."""
    log, settings = _log(tmp_path / "log", ROOMS.encode()), Settings(places="rooms")
    tail(log, one_database, settings, once=True)
    with LogWriter(log) as writer:
        writer.append(MAP_KEY, drawn_map("### #.# ###", 1.0, (-90.0, 0.0, 0.0)).encode())
    tail(log, one_database, settings, once=True)
    assert [r.differing for r in check(log, one_database, settings)] == [0, 0]


@pytest.mark.parametrize("size", [1, 3])
def test_regions_in_rows_follow_keyframes_of_other_places(tmp_path: Path, size: int) -> None:
    """A pose takes floor from places that its event does not name."""
    log, settings = _log(tmp_path / "log", ROOMS.encode()), Settings(places="rooms")
    live, fresh = followed_and_rebuilt(log, settings, size)
    assert live.graph["Place"] == fresh.graph["Place"]
    with LogReader(log) as reader:
        halves = [fold_log(reader, settings, Offset(end))[1] for end in (9, 17)]
    (first, *_), (later, other) = (list(place_regions(view).values()) for view in halves)
    assert first.area_m2 > later.area_m2, "the second place has taken floor from the first"
    free = int((ROOMS.cells == 0).sum())
    assert later.area_m2 + other.area_m2 == free
    assert all('"region": "{' in properties for _, properties in live.graph["Place"].values())


def test_what_is_no_map_is_parked(tmp_path: Path, one_database: Targets) -> None:
    log = _log(tmp_path / "log", b'{"resolution": 0}')
    report = tail(log, one_database, Settings(), once=True)
    assert [letter.offset for letter in report.parked] == [0]
    assert report.next_offset == 17


def _append(log: Path, *items: OccupancyMap | dict[str, Any]) -> int:
    with LogWriter(log) as writer:
        for item in items:
            if isinstance(item, OccupancyMap):
                writer.append(MAP_KEY, item.encode())
            else:
                writer.append(KEY, payload(item))
        return writer.next_offset


def _as_folded(log: Path, until: int | None = None) -> list[tuple[Any, ...]]:
    """Offset, floor and digest of the maps in force, from a fold of the log."""
    with LogReader(log) as reader:
        view = fold_log(reader, Settings(), until)[1]
    return [(g.offset, f, g.map.digest()) for f, g in view.maps_in_force().items()]


def _in_database(targets: Targets) -> list[tuple[Any, ...]]:
    return [(row[0], row[1], row[-1]) for row in map_rows(targets.graph_url)[:-1]]


def _on(floor: str, *documents: dict[str, Any]) -> list[dict[str, Any]]:
    return [{**document, "floor": floor} for document in documents]


HALL = drawn_map("########## #........# #........# #........# ##########", 1.0, (-2.0, -2.0, 0.0))
EVENTS = [
    ROOMS,
    *_on("0", *EAST[:3]),
    ROOMS,
    replace(ROOMS, floor="1"),
    *_on("1", *WEST[:3]),
    HALL,
    replace(HALL, floor="1"),
    replace(HALL, floor="0", source="named"),
    *_on("0", *EAST[3:5]),
]


@pytest.mark.parametrize("targets", mostly_slow(["one_database", "two_databases"]))
def test_the_table_has_the_maps_in_force_after_every_step(
    request: pytest.FixtureRequest, tmp_path: Path, targets: str
) -> None:
    """Whatever is appended between two tails: the rows are those of a fold, and of a rebuild."""
    found: Targets = request.getfixturevalue(targets)
    log, rng = tmp_path / "log", random.Random(7)
    at = 0
    while at < len(EVENTS):
        step = rng.randrange(1, 4) + rounds(0, 1)
        end = _append(log, *EVENTS[at : at + step])
        at += step
        tail(log, found, Settings(), once=True)
        assert _in_database(found) == _as_folded(log)
        assert [r.differing for r in check(log, found, Settings())] == [0, 0]
    tailed = all_rows(found)
    for until in range(0, end + 1, 3 * stride(4)):
        rebuild(log, found, Settings(), until=until)
        assert _in_database(found) == _as_folded(log, until)
    rebuild(log, found, Settings())
    assert all_rows(found) == tailed
    report = rebuild(log, found, Settings(), only="graph")
    assert report.rows["occupancy_map"] == 2
    assert {row[1] for row in _in_database(found)} == {"0", "1"}


def test_memory_has_the_rows_of_the_database(tmp_path: Path, one_database: Targets) -> None:
    log = tmp_path / "log"
    _append(log, *EVENTS)
    live, fresh = followed_and_rebuilt(log, Settings(), 3)
    tail(log, one_database, Settings(), once=True)
    assert live.maps == fresh.maps
    assert [tuple(row) for row in live.maps] == map_rows(one_database.graph_url)[:-1]


@pytest.mark.slow
def test_a_command_that_refolds_keeps_the_maps(tmp_path: Path, one_database: Targets) -> None:
    log = tmp_path / "log"
    _append(log, *EVENTS)
    tail(log, one_database, Settings(), once=True)
    before = map_rows(one_database.graph_url)
    run = Commands.in_folder(tmp_path)
    run("edit", "log", "forget-run", "run-a", "--reason", "test")
    assert tail(log, one_database, Settings(), once=True).refolds == 1
    forgotten = map_rows(one_database.graph_url)
    assert [row[1] for row in forgotten[:-1]] == [None, "1", "0"], "the log has no first floor now"
    assert [r.differing for r in check(log, one_database, Settings())] == [0, 0]
    assert forgotten != before


CHANGES: list[tuple[LiteralString, str]] = [
    ("UPDATE mapfold.occupancy_map SET png = 'junk'", "different"),
    ("UPDATE mapfold.occupancy_map SET resolution = 2.0", "different"),
    ("DELETE FROM mapfold.occupancy_map", "missing"),
    ("UPDATE mapfold.occupancy_map SET digest = 'junk'", "different"),
    ("UPDATE mapfold.occupancy_map SET log_offset = 9", "extra"),
    ("UPDATE mapfold.occupancy_map SET floor = 'cellar'", "different"),
]


@pytest.mark.slow
def test_check_finds_a_changed_map_and_repairs_it(tmp_path: Path, one_database: Targets) -> None:
    log = _log(tmp_path / "log", ROOMS.encode())
    rebuild(log, one_database, Settings())
    for change, kind in every_other(CHANGES):
        with psycopg.connect(one_database.graph_url) as connection:
            connection.execute(change)
        graph, vectors = check(log, one_database, Settings())
        assert {d.table for d in graph.differences} == {"occupancy_map"}, change
        assert kind in {d.kind for d in graph.differences}, change
        assert vectors.sound
        if "png" in change:
            with pytest.raises(DatabaseError, match=r"log_offset 0: png: .* run `mapfold replay"):
                ask(one_database)
        rebuild(log, one_database, Settings())
        assert [r.differing for r in check(log, one_database, Settings())] == [0, 0], change


def ask(targets: Targets) -> MapCandidates:
    with CandidateReader(targets) as reader:
        return reader.candidates([QuestionCrop(np.array([1.0, 0.0, 0.0], np.float32), None, None)])


def test_a_map_that_killed_its_tail_is_written_by_the_next(
    tmp_path: Path, one_database: Targets
) -> None:
    """A batch that fails takes the map with it; the checkpoint says so."""
    log = tmp_path / "log"
    _append(log, *EAST[:4])
    tail(log, one_database, Settings(), once=True)
    _append(log, ROOMS, *EAST[4:6])
    with psycopg.connect(one_database.graph_url, autocommit=True) as connection:
        connection.execute(
            "ALTER TABLE mapfold.occupancy_map ADD CONSTRAINT never CHECK (width < 0) NOT VALID"
        )
        with pytest.raises(DatabaseError):
            tail(log, one_database, Settings(), once=True)
        assert map_rows(one_database.graph_url) == [(None,)]
        assert connection.execute("SELECT max(next_offset) FROM mapfold.checkpoint").fetchone() == (
            4,
        )
        connection.execute("ALTER TABLE mapfold.occupancy_map DROP CONSTRAINT never")
    assert tail(log, one_database, Settings(), once=True).next_offset == 7
    assert _in_database(one_database) == _as_folded(log)


@pytest.mark.slow
def test_the_largest_map_is_written_and_read(tmp_path: Path, one_database: Targets) -> None:
    cells = np.random.default_rng(1).choice(np.array([0, 100, 255], np.uint8), (4000, 4000))
    log = tmp_path / "log"
    _append(log, *EAST[:2])
    tail(log, one_database, Settings(), once=True)
    _append(log, OccupancyMap(None, 0.05, (0.0, 0.0, 0.1), "noise", cells))
    tail(log, one_database, Settings(), once=True)
    assert _in_database(one_database) == _as_folded(log)
    assert [r.differing for r in check(log, one_database, Settings())] == [0, 0]
