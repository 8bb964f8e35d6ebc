"""`find`, `room` and `path`: answers of the log and of the databases are the same, and goals can be
driven to and see the thing."""

import json
import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from eventsrc.base.errors import MisuseError
from eventsrc.log import LogReader
from projections.ask.driven_ground import DrivenGround
from projections.ask.find import Wanted, find
from projections.ask.room_and_path import goal_of, path, room
from projections.fold.free_floor import free_floor
from projections.fold.settings import Settings
from projections.map.view import MapView
from projections.postgres import rebuild
from projections.postgres.connection import Targets, connect
from projections.postgres.queries.candidate_search import prepare_graph
from projections.postgres.queries.live_view import read_view
from projections.store.history_recorder import map_after
from projections.surfaces.python import Map, fold
from tests.support.commands import Commands
from tests.support.evidence_drives import long_drive
from tests.support.logs import SAMPLE, write_log
from tests.support.thorough import stride

FULL = Settings(places="rooms", fusion="evidence")


@pytest.fixture(scope="module")
def house() -> Map:
    return fold(SAMPLE, embeddings=False)


@pytest.fixture(scope="module")
def sample(house: Map) -> MapView:
    return house.view


@pytest.fixture
def mapfold(tmp_path: Path) -> Commands:
    return Commands.in_folder(tmp_path)


def same(document: Any) -> Any:
    return json.loads(json.dumps(document))


def answers(view: MapView) -> list[Any]:
    """All questions of a map, as JSON."""
    objects = [each.object_id for each in view.objects.values()]
    places = [each.place_id for each in view.places.values()]
    ends = [*places, "0,0"]
    asked = [
        *({"what": None, "top": 1000, "every": True}, {"top": 5, "near": "1,1"}),
        *({"start": "2,1", "top": 1000}, {"missing": True}, {"moved": True, "every": True}),
    ]
    found = [find(view, Wanted(**each)).document() for each in asked]
    found += [room(view, each).document() for each in places]
    found += [path(view, ends[0], each).document() for each in ends]
    found += [goal_of(view, each, 0.0).document() for each in objects if has_goal(view, each)]
    return [same(each) for each in found]


def has_goal(view: MapView, object_id: str) -> bool:
    try:
        goal_of(view, object_id, 0.0)
    except MisuseError:
        return False
    return True


def test_the_databases_answer_as_the_log(tmp_path: Path, one_database: Targets) -> None:
    log = write_log(tmp_path / "log", long_drive(5, each=30))
    rebuild(log, one_database, FULL)
    with LogReader(log) as reader:
        view = map_after(reader, FULL, reader.next_offset)
    with connect(one_database.graph_url, autocommit=True) as connection:
        prepare_graph(connection)
        live = read_view(connection)
    assert answers(live) == answers(view)
    assert live.next_offset == view.next_offset
    assert any(each["moved_from"] for each in answers(live)[4]["answers"])


@pytest.mark.slow
def test_the_databases_have_the_walls_and_python_gives_the_same(
    mapfold: Commands, one_database: Targets, house: Map
) -> None:
    mapfold("replay", SAMPLE, "--db", one_database.graph_url)
    asked = (
        (("find", "sinks", "--from", "1,1"), house.find("sinks", start=(1, 1))),
        (("find", "oven", "--goal", "json"), house.goal("oven")),
        (("room", "kitchen"), house.room("kitchen")),
        (("path", "1,1", "oven"), house.path((1, 1), "oven")),
    )
    for (command, *rest), found in asked[:: stride(3)]:
        live = mapfold(command, *rest, "--json", "--db", one_database.graph_url).json
        assert live == same(found.document())
        assert live == mapfold(command, SAMPLE, *rest, "--json").json
    said = mapfold("find", "--db", one_database.graph_url, "sinks", "--in", "kitchen").out
    assert "1 kitchen" in said


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("find",), "give a LOG, or --db URL"),
        (
            ("find", "log", "cup", "--db", "postgresql://x/y"),
            "--db asks the databases, not the log",
        ),
        (("find", "cup", "--db", "postgresql://x/y", "--at", "3"), "only the log knows"),
        (("find", "cup", "--db", "postgresql://x/y", "--set", "eps_m=1"), "--log LOG"),
        (("room", SAMPLE), "give the NAME of a place"),
        (("room", SAMPLE, "ballroom"), "no place 'ballroom'"),
        (("path", SAMPLE, "kitchen"), "give both ends A and B"),
        (("path", SAMPLE, "kitchen", "bathroom", "--goal", "json"), "--goal faces a thing"),
        (("path", SAMPLE, "kitchen", "nan,nan"), "no place or object 'nan,nan'"),
        (("find", SAMPLE, "chair", "--goal", "json", "--clearance", "40"), "a smaller --clearance"),
    ],
)
def test_what_cannot_be_answered_is_an_error_that_says_why(
    mapfold: Commands, words: tuple[Any, ...], said: str
) -> None:
    refused = mapfold(*words, code=2).err
    assert said in refused
    assert len(refused.strip().splitlines()) == 1


def test_a_way_goes_over_driven_ground_and_never_through_walls(sample: MapView) -> None:
    ground = DrivenGround(sample)
    (given,) = sample.maps_in_force().values()
    grid = free_floor(given.map).grid
    driven = {(k.pose.x_um / 1e6, k.pose.y_um / 1e6) for k in sample.keyframes if k.pose}
    places = [each.place_id for each in sample.places.values()]
    for end in places[1:]:
        way = path(sample, places[0], end)
        assert set(way.way_points) <= driven
        assert [way.places[0].place_id, way.places[-1].place_id] == [places[0], end]
        assert [d.after for d in way.doors] == [p.place_id for p in way.places[1:]]
        steps = list(pairwise(way.way_points))
        assert way.length_m == pytest.approx(sum(math.dist(*step) for step in steps))
        assert way.length_m >= math.dist(way.way_points[0], way.way_points[-1])
        back = path(sample, end, places[0])
        assert back.length_m == pytest.approx(way.length_m)
        for a, b in steps:
            a_um, b_um = ((round(x * 1e6), round(y * 1e6)) for x, y in (a, b))
            assert math.dist(a, b) < 1.5 or grid.is_free_line(a_um, b_um)
    # The shortest by trying all: relax every link until nothing gets shorter.
    lengths, _ = ground.lengths_from(0)
    for node in lengths:
        between = ground.nodes_between(0, node)
        assert between is not None
        spots = [ground.spots[each] for each in between]
        assert lengths[node] == pytest.approx(sum(math.dist(*step) for step in pairwise(spots)))


def test_a_goal_is_clear_of_walls_and_sees_the_thing(sample: MapView) -> None:
    (given,) = sample.maps_in_force().values()
    grid = free_floor(given.map).grid
    rows, columns = grid.walls.shape
    walls = [
        (grid.in_map(column, row)[0] / 1e6, grid.in_map(column, row)[1] / 1e6)
        for row in range(rows)
        for column in range(columns)
        if 50 <= grid.source.cells[row, column] <= 100
    ]
    half = grid.source.resolution / 2
    goals = free = 0
    for each in sample.objects.values():
        if not each.confirmed or not has_goal(sample, each.object_id):
            continue
        goals += 1
        goal = goal_of(sample, each.object_id, 0.2)
        at = goal.x, goal.y
        assert min(math.dist(at, (x + half, y + half)) for x, y in walls) >= 0.2
        assert goal.distance_m == pytest.approx(math.dist(at, each.spot))
        facing = math.atan2(each.spot[1] - goal.y, each.spot[0] - goal.x)
        assert goal.yaw == pytest.approx(facing)
        ends = [(round(x * 1e6), round(y * 1e6)) for x, y in (at, each.spot)]
        saw = {(k.run_id, k.keyframe_id) for k in sample.sightings(each)}
        assert goal.ground == "seen" or grid.is_free_line(*ends)
        assert (goal.ground == "seen") == ((goal.run_id, goal.keyframe_id) in saw)
        free += grid.is_free_line(*ends)
        assert goal.walls_known
        assert goal.ground != "seen" or goal.distance_m < 3.5
    assert goals > 40
    assert free >= 0.9 * goals


def test_a_goal_is_printed_for_ros(mapfold: Commands, house: Map) -> None:
    goal = same(house.goal("oven").document())
    yaml = mapfold("find", SAMPLE, "oven", "--goal", "yaml").out
    line = mapfold("path", SAMPLE, "bathroom", "oven", "--goal", "ros2").out
    assert f"position: {{x: {goal['x']:.3f}, y: {goal['y']:.3f}, z: 0.0}}" in yaml
    assert yaml.startswith("header:\n")
    assert line.startswith("ros2 topic pub --once /goal_pose geometry_msgs/msg/PoseStamped '{")
    assert f"x: {goal['x']:.3f}" in line
    way = same(house.path("bathroom", "oven").document())
    assert way["goal"] == goal
    assert way["way_points"][-1] == [goal["x"], goal["y"]]
    assert "passage" in mapfold("path", SAMPLE, "bathroom", "oven").out


def test_the_way_to_a_thing_counts_not_the_straight_line(sample: MapView) -> None:
    found = find(sample, Wanted(start="kitchen", top=1000)).answers
    ways = [math.inf if each.way_m is None else each.way_m for each in found]
    assert ways == sorted(ways)
    start = room(sample, "kitchen")
    for each in found:
        straight = math.dist((start.centroid_x, start.centroid_y), (each.x, each.y))
        assert each.way_m is None or each.way_m >= straight - 1e-6


def test_runs_that_never_meet_have_no_way_between_them(tmp_path: Path, mapfold: Commands) -> None:
    documents = long_drive(5, runs=1)
    far = [
        {**each, "run_id": "far", "map_x": each["map_x"] + 500.0}
        for each in documents
        if each.get("map_x") is not None
    ]
    write_log(tmp_path / "log", [*documents, *far])
    said = mapfold("path", "log", "0,0", "500,0", code=2).err
    assert "no way from 0,0 to 500,0: no robot drove one in steps of 5 m or less" in said


def test_room_tells_what_it_is_and_holds(mapfold: Commands, house: Map, sample: MapView) -> None:
    document = same(house.room("kitchen").document())
    (place,) = (p for p in sample.places.values() if p.place_id == document["place_id"])
    inside = [o for o in sample.objects.values() if o.place == place.ordinal]
    assert {o["object_id"] for o in document["objects"]} == {
        o.object_id for o in inside if o.confirmed
    }
    assert document["unconfirmed"] == sum(not o.confirmed for o in inside)
    beside = {
        sample.place_id(b if a == place.ordinal else a): n
        for a, b, n in sample.edges()
        if place.ordinal in (a, b)
    }
    assert {n["place_id"]: n["shared_transitions"] for n in document["neighbours"]} == beside
    times = [sample.keyframes[k].timestamp for k in place.members]
    assert document["first_visited"]["time"] == min(times)
    assert document["last_visited"]["time"] == max(times)
    said = mapfold("room", SAMPLE, "kitchen").out
    assert "kitchen (probability 0." in said
    assert all(visible in said for visible in ("next to ", "visited ", "oven"))
