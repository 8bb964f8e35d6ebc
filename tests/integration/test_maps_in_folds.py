"""Occupancy maps in the fold: the view, the digest, kept folds, time travel, state and pictures."""

import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from eventsrc.envelope.occupancy_map import OccupancyMap
from eventsrc.envelope.system_events import MAP_KEY
from eventsrc.log import LogReader, LogWriter
from projections.fold.map_errors import FoldError
from projections.fold.settings import Settings
from projections.history import LogTimeline
from projections.map.digest import map_digest
from projections.map.fold import fold_events, fold_log
from projections.map.view import MapView
from projections.surfaces.cli.folded_log import view_of_floor
from tests.support.commands import Commands
from tests.support.envelopes import envelope, payload
from tests.support.fixtures_log import KEY
from tests.support.folds import Folded, resumed
from tests.support.maps import drawn_map
from tests.support.thorough import mostly_slow

HALL = drawn_map("########## #........# #........# #........# ##########", 1.0, (-2.0, -2.0, 0.0))
ROOMS = drawn_map("########## #...#....# #...#....# #........# ##########", 1.0, (-2.0, -2.0, 0.0))
DRIVE = [envelope(k, k / 2, 0.0) for k in range(8)]


def _write(path: Path, *items: dict[str, Any] | OccupancyMap | bytes) -> Path:
    with LogWriter(path) as writer:
        for item in items:
            if isinstance(item, dict):
                writer.append(KEY, payload(item))
            else:
                writer.append(MAP_KEY, item if isinstance(item, bytes) else item.encode())
    return path


def _view(log: Path, until: int | None = None) -> MapView:
    with LogReader(log) as reader:
        return fold_log(reader, Settings(), until)[1]


def _map_at(view: MapView) -> int | None:
    return None if view.map is None else view.map.offset


def test_a_view_has_the_last_map_before_its_end(tmp_path: Path) -> None:
    log = _write(tmp_path / "L", *DRIVE[:3], HALL, *DRIVE[3:5], ROOMS, *DRIVE[5:])
    assert [_map_at(_view(log, until)) for until in (3, 4, 6, 7, 10)] == [None, 3, 3, 6, 6]
    last = _view(log).map
    assert last is not None
    assert np.array_equal(last.map.cells, ROOMS.cells)


def test_only_the_digest_tells_a_map_under_the_pages_rule(tmp_path: Path) -> None:
    plain = _view(_write(tmp_path / "plain", *DRIVE))
    mapped = _view(_write(tmp_path / "mapped", HALL, *DRIVE))
    again = _view(_write(tmp_path / "again", *DRIVE, HALL))
    other = _view(_write(tmp_path / "other", ROOMS, *DRIVE))
    assert [p.unordered_members for p in mapped.places.values()] == [
        p.unordered_members for p in plain.places.values()
    ]
    assert map_digest(mapped) == map_digest(again)
    assert len({map_digest(view) for view in (plain, mapped, other)}) == 3
    mapped.maps.clear()
    assert map_digest(mapped) == map_digest(plain)


ROOM_RULE = Settings(places="rooms")


def _places(log: Path, settings: Settings = ROOM_RULE) -> list[int | None]:
    with LogReader(log) as reader:
        return [k.place for k in fold_log(reader, settings)[1].keyframes]


def test_places_by_rooms_do_not_reach_through_a_wall(tmp_path: Path) -> None:
    east = [envelope(k, 4.0 - 0.25 * (k % 4), 0.0) for k in range(8)]
    west = [envelope(k, 1.7 - 0.25 * (k % 4), 0.0) for k in range(8, 16)]
    assert len(set(_places(_write(tmp_path / "plain", *east, *west)))) == 1
    assert len(set(_places(_write(tmp_path / "hall", HALL, *east, *west)))) == 1
    apart = _places(_write(tmp_path / "rooms", ROOMS, *east, *west))
    assert apart == [0] * 8 + [1] * 8
    assert None not in apart


def test_a_map_is_of_the_first_floor_of_a_log_only(tmp_path: Path) -> None:
    east = [envelope(k, 4.0 - 0.25 * (k % 4), 0.0, floor="0") for k in range(8)]
    west = [envelope(k, 1.7 - 0.25 * (k % 4), 0.0, floor="0") for k in range(8, 16)]
    above = [
        envelope(k, e["map_x"], e["map_y"], floor="1")
        for k, e in enumerate((*east, *west), start=16)
    ]
    places = _places(_write(tmp_path / "rooms", ROOMS, *east, *west, *above))
    assert places == [0] * 8 + [1] * 8 + [2] * 16


def test_state_and_pictures_have_the_maps_of_floors(tmp_path: Path) -> None:
    run = Commands.in_folder(tmp_path)
    east = [envelope(k, 4.0 - 0.25 * (k % 4), 0.0, floor="0") for k in range(8)]
    above = [envelope(k, 1.7 - 0.25 * (k % 4), 0.0, floor="1") for k in range(8, 16)]
    upstairs = replace(ROOMS, floor="1")
    _write(tmp_path / "L", HALL, upstairs, *east, *above)
    shown = run("state", "L", "--preset", "rooms", "--json").json
    assert shown["map"]["offset"] == 0
    assert [(m["offset"], m.get("floor")) for m in shown["maps"]] == [(0, None), (1, "1")]
    text = run("state", "L", "--preset", "rooms").out
    assert "walls    10 × 5 cells of 1 m of floor 0, from drawing at offset 0\n" in text
    assert "walls    10 × 5 cells of 1 m of floor 1, from drawing at offset 1\n" in text
    with LogReader(tmp_path / "L") as reader:
        _, view = fold_log(reader, Settings())
    one, other = (view_of_floor(view, floor).map for floor in "01")
    assert one is not None
    assert other is not None
    assert (one.map.cells.tolist(), other.map.cells.tolist()) == (
        HALL.cells.tolist(),
        upstairs.cells.tolist(),
    )
    with LogTimeline(tmp_path / "L", Settings()) as timeline:
        for until in range(19):
            past, folded = timeline.at(until), _view(tmp_path / "L", until)
            assert past.maps_in_force().keys() == folded.maps_in_force().keys()
            assert map_digest(past) == map_digest(folded)


def test_a_map_holds_for_what_comes_after_it_only(tmp_path: Path) -> None:
    """What was one place before the map stays one; new ground is judged by it."""
    both = [envelope(k, 0.2 + 0.4 * k, 0.0) for k in range(12)]
    before = _write(tmp_path / "before", *both, ROOMS)
    assert len(set(_places(before))) == 1
    after = _write(tmp_path / "after", ROOMS, *both)
    assert len(set(_places(after))) == 2
    lifted = _write(tmp_path / "lifted", ROOMS, HALL, *both)
    assert len(set(_places(lifted))) == 1


def test_a_fold_goes_on_from_a_kept_state_with_the_same_walls(tmp_path: Path) -> None:
    items = [*DRIVE[:3], ROOMS, *DRIVE[3:], *(envelope(k, 0.3 * k, 0.5) for k in range(20, 34))]
    log = _write(tmp_path / "L", *items)
    with LogReader(log) as reader:
        _, whole = fold_log(reader, ROOM_RULE)
        for until in range(2, len(items), 3):
            again = resumed(Folded(*fold_log(reader, ROOM_RULE, until), []))
            for event in fold_events(reader.read(until), again.map):
                again.view.apply_event(event.offset, event.deltas)
            assert map_digest(again.view) == map_digest(whole)


def test_a_kept_fold_has_the_map(tmp_path: Path) -> None:
    log = _write(tmp_path / "L", *DRIVE, HALL)
    with LogReader(log) as reader:
        again = resumed(Folded(*fold_log(reader, Settings()), []))
    given = again.map.current_map.given[None]
    assert (given.offset, given.map.origin) == (8, HALL.origin)
    assert again.map.use_map(9, ROOMS)[0] is again.map.current_map.given[None]


def test_time_travel_has_the_map_of_its_time(tmp_path: Path) -> None:
    log = _write(tmp_path / "L", *DRIVE[:3], HALL, *DRIVE[3:], ROOMS)
    with LogTimeline(log, Settings()) as timeline:
        for until in range(len(DRIVE) + 3):
            folded, past = _view(log, until), timeline.at(until)
            assert _map_at(past) == _map_at(folded)
            assert map_digest(past) == map_digest(folded)


def test_what_is_no_map_stops_a_fold_at_its_offset(tmp_path: Path) -> None:
    log = _write(tmp_path / "L", *DRIVE[:2], b'{"resolution": 1.0}')
    with pytest.raises(FoldError, match=r"offset 2 .* is on mapfold/map and no map: origin: req"):
        _view(log)
    assert _view(log, 2).next_offset == 2


def test_state_names_the_map_only_where_there_is_one(tmp_path: Path) -> None:
    run = Commands.in_folder(tmp_path)
    _write(tmp_path / "plain", *DRIVE)
    _write(tmp_path / "mapped", *DRIVE, HALL)
    assert "map" not in run("state", "plain", "--json").json
    assert "walls" not in run("state", "plain").out
    assert run("state", "mapped", "--json").json["map"] == {
        "offset": 8,
        "map_id": None,
        "source": "drawing",
        "resolution": 1.0,
        "origin": [-2.0, -2.0, 0.0],
        "width": 10,
        "height": 5,
        "digest": HALL.digest(),
    }
    named = "walls    10 × 5 cells of 1 m, from drawing at offset 8"
    unused = "; places=page does not use them for places, --preset full does"
    assert f"{named}{unused}\n" in run("state", "mapped").out
    assert f"{named}\n" in run("state", "mapped", "--preset", "rooms").out


@pytest.mark.parametrize("suffix", mostly_slow(["svg", "png", "pdf"]))
@pytest.mark.slow
def test_a_picture_shows_the_walls_and_stays_the_same(tmp_path: Path, suffix: str) -> None:
    run = Commands.in_folder(tmp_path)
    _write(tmp_path / "plain", *DRIVE)
    _write(tmp_path / "mapped", HALL, *DRIVE)
    for log, out in (("plain", "a"), ("mapped", "b"), ("mapped", "c")):
        run("draw", log, "--out", f"{out}.{suffix}")
    plain, once, again = (tmp_path.joinpath(f"{n}.{suffix}").read_bytes() for n in "abc")
    assert once == again
    assert once != plain
    if suffix == "svg":
        images = [len(ET.fromstring(text).findall(".//{*}image")) for text in (plain, once)]
        assert images == [0, 2]
