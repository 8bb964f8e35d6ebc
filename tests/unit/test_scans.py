"""Walls by the robots' own scans: the grid, the maps made of it, and what makes way for what."""

import math
from typing import Any

import numpy as np
import pybase64
import pytest

from eventsrc.envelope.commands import CorrectPoses, RigidTransform
from eventsrc.envelope.ingest import Accepted, Rejected, ingest
from eventsrc.envelope.model import NO_RETURN_MM, Offset, StatedScan
from eventsrc.envelope.occupancy_map import MAX_MAP_CELLS, SCANS, UNKNOWN, OccupancyMap
from projections.fold import scans
from projections.fold.corrections import NO_CORRECTIONS
from projections.fold.deltas import MapGiven, Pose
from projections.fold.exact import UM_PER_M
from projections.fold.free_floor import FreeFloor
from projections.fold.occupancy import NOWHERE, OccupancyGrid
from projections.fold.settings import Settings
from projections.map.digest import map_digest
from projections.map.state_output import state_text
from projections.map.view import MapView
from projections.store.history import History
from projections.store.stored_view import StoredView
from projections.store.tables import Tables, TableWriter
from tests.support.envelopes import detection, envelope, payload
from tests.support.evidence_drives import compiled
from tests.support.folds import Folded, accepted, resumed, state_bytes

ROOMS = Settings(places="rooms", fusion="evidence")
HALF_M = 3.0
"""Half the side of a square room around the origin."""


def ranges_in_room(x: float, y: float, yaw: float, beams: int = 360) -> list[int]:
    """Millimetres to the walls of the room, beam by beam from ahead to the left."""
    made = []
    for beam in range(beams):
        cos, sin = (f(yaw + beam * 2.0 * math.pi / beams) for f in (math.cos, math.sin))
        far = [
            (HALF_M - sign * at) / abs(part)
            for at, part in ((x, cos), (y, sin))
            if abs(part) > 1e-9
            for sign in (math.copysign(1.0, part),)
        ]
        made.append(round(1000 * min(far)))
    return made


def scan(ranges: list[int], **fields: Any) -> dict[str, Any]:
    raw = np.array(ranges, "<u2").tobytes()
    about = {"angle_min": 0.0, "angle_step": 2.0 * math.pi / len(ranges), "range_max": 10.0}
    return {**about, "ranges_mm": pybase64.b64encode(raw).decode(), **fields}


def drive(count: int = 40, **more: Any) -> list[dict[str, Any]]:
    """Keyframes on a circle in the room."""
    documents = []
    for number in range(count):
        angle = 0.3 * number
        x, y = math.cos(angle), math.sin(angle)
        seen = [detection("cup", [1.0, 0.1 * (number % 7)])]
        fields = {"map_yaw": angle, "scan": scan(ranges_in_room(x, y, angle)), **more}
        documents.append(envelope(number, x, y, detections=seen, **fields))
    return documents


def walls_of(given: OccupancyMap) -> set[tuple[int, int]]:
    """The wall cells by decimetres of the map frame."""
    x, y = (round(10 * part) for part in given.origin[:2])
    rows, columns = np.nonzero(given.cells == 100)
    return {(x + int(c), y + int(r)) for r, c in zip(rows, columns, strict=True)}


def test_the_walls_of_a_room_are_where_the_beams_end_and_inside_is_free() -> None:
    view = Folded.start(ROOMS).extend(drive()).view
    given = view.map
    assert given is not None
    assert given.scanned
    assert given.map.source == "scans"
    near = walls_of(given.map)
    edge = {-31, -30, 29, 30}
    assert len(near) > 200
    assert all(c in edge or r in edge for c, r in near)
    x, y = (round(10 * part) for part in given.map.origin[:2])
    inside = given.map.cells[-18 - y : 18 - y, -18 - x : 18 - x]
    assert (inside == 0).all()


def test_a_cell_that_beams_pass_later_is_no_wall_any_more() -> None:
    grid = scans.ScannedFloor()
    near = StatedScan(**scan([1000] * 360))
    far = StatedScan(**scan([5000] * 360))
    for _ in range(3):
        grid.cast(Pose(0, 0, 0.0), near)
    at = 10 - grid.column, -grid.row
    assert grid.odds[at[1], at[0]] == 3 * scans.HIT
    for _ in range(20):
        grid.cast(Pose(0, 0, 0.0), far)
    assert grid.odds[at[1], at[0]] == 3 * scans.HIT + 20 * scans.PASSED
    for _ in range(40):
        grid.cast(Pose(0, 0, 0.0), far)
    assert grid.odds.min() == -scans.MOST
    assert grid.odds.max() == scans.MOST


def test_beams_of_which_nothing_is_known_change_nothing_and_those_that_end_nowhere_clear() -> None:
    grid = scans.ScannedFloor()
    grid.cast(Pose(0, 0, 0.0), StatedScan(**scan([0] * 16)))
    assert not grid.odds.any()
    grid.cast(Pose(0, 0, 0.0), StatedScan(**scan([NO_RETURN_MM] * 16, range_max=2.0)))
    assert not (grid.odds > 0).any()
    rows, columns = np.nonzero(grid.odds)
    assert max(np.hypot(rows + grid.row, columns + grid.column)) <= 20


def test_of_scans_that_say_nothing_no_map_is_made_however_many_there_are() -> None:
    blind = [{**d, "scan": scan([0] * 16)} for d in drive(2 * 2 * scans.FIRST_DOUBLING)]
    folded = Folded.start(ROOMS).extend(blind)
    assert not folded.all(MapGiven)
    assert folded.extend(drive(40, run_id="sees")).all(MapGiven)


def test_no_way_on_a_map_of_scans_goes_over_unknown_ground() -> None:
    cells = np.zeros((8, 30), np.uint8)
    cells[:, 10:20] = UNKNOWN
    for source, is_way in ((SCANS, False), ("map.yaml", True)):
        floor = FreeFloor(OccupancyGrid(OccupancyMap(None, 0.1, (0.0, 0.0, 0.0), source, cells)))
        start, end, unknown = (
            floor.block_at((x, 450_000)) for x in (250_000, 2_550_000, 1_500_000)
        )
        assert start is not None
        assert end is not None
        assert unknown is not None
        assert (floor.nearest(start, {end: 7}) is not None) == is_way
        assert floor.nearest(start, {end: 7, start + 2: 9}) == (9, 6)
        assert (floor.label(unknown) != NOWHERE) == is_way


def test_the_middles_of_cells_around_the_sensor_are_by_direction_and_distance() -> None:
    sector, far_mm = scans._around(1, 3)
    middle = len(sector) // 2
    assert far_mm[middle, middle + 10] == math.isqrt(round(1012.5**2 + 37.5**2))
    assert sector[middle, middle + 10] == 2048 - round(2048 * 37.5 / 1012.5 / 2 / math.pi)
    assert abs(sector[middle + 10, middle] - 512) <= 8
    assert sector[middle, middle - 10] == 1036


def test_the_sensor_may_stand_and_look_elsewhere_on_the_robot() -> None:
    plain, mounted = scans.ScannedFloor(), scans.ScannedFloor()
    ranges = ranges_in_room(0.5, 0.2, math.pi / 2)
    plain.cast(Pose(500_000, 200_000, math.pi / 2), StatedScan(**scan(ranges)))
    moved = scan(ranges, x=0.2, y=-0.5, yaw=math.pi / 2)
    mounted.cast(Pose(300_000, 700_000, 0.0), StatedScan(**moved))
    assert (plain.column, plain.row) == (mounted.column, mounted.row)
    assert (plain.odds == mounted.odds).all()


def test_a_given_map_wins_over_scans_before_and_after_it() -> None:
    documents = drive(30)
    folded = Folded.start(ROOMS).extend(documents[:15])
    assert folded.all(MapGiven)
    given = OccupancyMap("m", 0.1, (-4.0, -4.0, 0.0), "map", np.zeros((80, 80), np.uint8))
    offset = folded.map.next_offset
    folded.view.apply_event(offset, folded.map.use_map(offset, given))
    before = len(folded.all(MapGiven))
    folded.extend(documents[15:])
    assert len(folded.all(MapGiven)) == before
    assert folded.view.map is not None
    assert folded.view.map.map is given


def test_without_a_pose_a_scan_says_nothing_and_a_log_without_scans_has_no_map() -> None:
    lost = [{**d, "map_x": None, "map_y": None, "map_yaw": None} for d in drive(10)]
    bare = [{k: v for k, v in d.items() if k != "scan"} for d in drive(10)]
    for documents in (lost, bare):
        folded = Folded.start(ROOMS).extend(documents)
        assert not folded.all(MapGiven)
        assert folded.map.current_map.dump() == {}


@pytest.mark.parametrize("floors", [False, True])
def test_folds_that_resume_and_histories_give_the_same_maps(floors: bool) -> None:
    documents = drive(50)
    if floors:
        documents = [{**d, "floor": "up" if n % 2 else "down"} for n, d in enumerate(documents)]
    whole, again = Folded.start(ROOMS).extend(documents), Folded.start(ROOMS)
    for document in documents:
        again = resumed(again).extend([document])
    assert state_bytes(again) == state_bytes(whole)
    assert map_digest(again.view) == map_digest(whole.view)
    assert set(whole.view.maps) == ({None, "up"} if floors else {None})
    view, writer = MapView(ROOMS), TableWriter(Tables())
    digests = []
    for offset, deltas in enumerate(whole.deltas):
        view.apply_event(Offset(offset), deltas)
        writer.add(Offset(offset), deltas)
        digests.append(map_digest(view))
    history = History(ROOMS, NO_CORRECTIONS, Tables(writer.finish()), _no_map)
    for end in range(1, len(documents) + 1, 7):
        past = StoredView(history, Offset(end))
        assert map_digest(past) == digests[end - 1]
        assert all(given.scanned for given in past.maps.values())


def _no_map(offset: Offset) -> Any:
    raise AssertionError(offset)


def test_a_scan_far_away_is_left_out_rather_than_filling_the_memory() -> None:
    grid = scans.ScannedFloor()
    one = StatedScan(**scan([1000] * 8))
    grid.cast(Pose(0, 0, 0.0), one)
    shape = grid.odds.shape
    grid.cast(Pose(10**13, -(10**13), 0.0), one)
    assert (grid.odds.shape, grid.scans) == (shape, 1)
    far = envelope(99, 10.0**6, 0.0, map_yaw=0.0, scan=scan([1000] * 8))
    folded = Folded.start(ROOMS).extend([*drive(3), far])
    assert folded.view.counts()["scan_too_far"] == 1
    assert "1 scan left out, too far from the first" in state_text(folded.view, None)


def cast_at(grid: scans.ScannedFloor, x_um: int) -> bool:
    return grid.cast(Pose(x_um, 0, 0.0), StatedScan(**scan([1000] * 8)))


@pytest.mark.parametrize("wrong", [1, 2, scans.FIRST_DOUBLING])
def test_a_wrong_beginning_is_given_up_once_more_scans_were_left_out(wrong: int) -> None:
    km, grid, anew = 10**9, scans.ScannedFloor(), scans.ScannedFloor()
    assert all(cast_at(grid, km) for _ in range(wrong))
    assert not any(cast_at(grid, 0) for _ in range(wrong))
    assert cast_at(grid, 0)
    assert cast_at(anew, 0)
    assert np.array_equal(grid.odds, anew.odds)
    assert (grid.column, grid.scans, grid.left_out) == (anew.column, 1, 0)


def test_neither_a_grid_of_many_scans_nor_one_that_goes_on_is_given_up() -> None:
    many, alternating = scans.ScannedFloor(), scans.ScannedFloor()
    for _ in range(scans.FIRST_DOUBLING + 1):
        assert cast_at(many, 0)
        assert cast_at(alternating, 0)
        assert not cast_at(alternating, 10**9)
    assert not any(cast_at(many, 10**9) for _ in range(100))
    assert many.scans == scans.FIRST_DOUBLING + 1


def test_the_map_of_a_run_that_began_a_kilometre_away_is_that_of_the_rest() -> None:
    wrong = envelope(0, 1000.0, 0.0, map_yaw=0.0, scan=scan([1000] * 8))
    documents = drive(9)  # of which the second is left out
    begun = Folded.start(ROOMS).extend([wrong, *documents[1:]])
    whole = Folded.start(ROOMS).extend(documents[2:])
    assert begun.view.counts()["scan_too_far"] == 1
    made, same = (folded.all(MapGiven)[-1].map for folded in (begun, whole))
    assert np.array_equal(made.cells, same.cells)
    assert made.origin == same.origin


def test_the_largest_map_of_scans_has_no_more_cells_than_a_map_may_have() -> None:
    grid = scans.ScannedFloor()
    open_space = StatedScan(**scan([NO_RETURN_MM] * 8))
    reach = scans.REACH_M * UM_PER_M // scans.CELL_UM + 2
    for cell in (reach, scans.MOST_CELLS - reach - 1):
        grid.cast(Pose(cell * scans.CELL_UM, cell * scans.CELL_UM, 0.0), open_space)
    assert grid.scans == 2
    made = grid.map(None)
    assert min(made.width, made.height) > scans.MOST_CELLS - 10
    assert made.cells.size <= MAX_MAP_CELLS


@pytest.mark.parametrize(
    ("change", "valid"),
    [
        ({"ranges_mm": ""}, True),
        ({"ranges_mm": "AAE="}, True),
        ({"ranges_mm": "AAE=\n"}, False),
        ({"ranges_mm": "A"}, False),
        ({"ranges_mm": "AAAA" * 961}, False),
        ({"angle_min": 8.0}, False),
        ({"range_max": 0.0}, False),
        ({"x": 101.0}, False),
        ({"more": [1]}, True),
        ({"more": math.nan}, False),
    ],
)
def test_a_scan_is_valid_or_refused(change: dict[str, Any], valid: bool) -> None:
    document = envelope(1, 0.0, 0.0, map_yaw=0.0, scan={**scan([1, 2]), **change})
    assert isinstance(ingest(payload(document)), Accepted if valid else Rejected)
    if valid:
        folded = Folded.start(ROOMS).extend([document])
        assert not folded.all(MapGiven)


def test_another_scan_is_other_content() -> None:
    one, other = (envelope(1, 0.0, 0.0, scan=scan([n])) for n in (1, 2))
    folded = Folded.start(ROOMS).extend([one, one, other])
    assert [d[0].kind for d in folded.deltas[1:]] == ["duplicate", "conflict"]
    assert accepted(one).envelope.scan is not None


def test_walls_move_with_corrected_poses() -> None:
    documents = drive(20)
    moved = CorrectPoses(
        command_id="c1",
        issued_by="a",
        run_id=documents[0]["run_id"],
        transform=RigidTransform.of(5.0, 0.0, 0.0),
    )
    there = Folded.start(ROOMS, compiled(moved)).extend(documents).view.map
    here = Folded.start(ROOMS).extend(documents).view.map
    assert here is not None
    assert there is not None
    assert there.map.origin[0] == pytest.approx(here.map.origin[0] + 5.0)
    assert (there.map.cells == here.map.cells).mean() > 0.99
