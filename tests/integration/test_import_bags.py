"""Bags of ROS 2, written by rosbags, become the log that their detections as JSON lines become."""

import json
import math
import shutil
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from eventsrc.base.errors import MisuseError
from eventsrc.log import LogReader
from projections.fold.settings import Settings
from projections.map.digest import map_digest
from projections.map.fold import fold_log
from tests.support import ros_messages as ros
from tests.support.commands import Commands
from tests.support.fixtures_log import read_log
from tests.support.ros_bags import DRIVE, RUN, Drive, Raw, envelopes, imported, write_bag
from tests.support.ros_messages import SECOND, START, flat
from tests.support.thorough import every_other, mostly_slow


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """One drive in every form, by storage and compression."""
    folder = tmp_path_factory.mktemp("drives")
    forms = [("mcap", "none"), ("sqlite", "none"), ("sqlite", "file"), ("sqlite", "message")]
    messages = [*DRIVE.messages()]
    return {
        f"{storage} {compression}": write_bag(
            folder / f"{storage}-{compression}" / "drive", messages, storage, compression
        )
        for storage, compression in forms
    }


def digest(log: Path, *settings: str) -> str:
    with LogReader(log) as reader:
        _, view = fold_log(reader, Settings().with_assignments(settings))
    return map_digest(view)


BOTH_RULES: tuple[tuple[str, ...], ...] = ((), ("fusion=evidence", "places=rooms"))


def same_map_as_json_lines(
    drive: Drive,
    bag: Path,
    tmp_path: Path,
    rules: tuple[tuple[str, ...], ...] = BOTH_RULES,
) -> None:
    lines = tmp_path / "lines.jsonl"
    lines.write_bytes(b"\n".join(drive.envelopes(RUN)))
    assert imported(tmp_path / "lines", lines).rejected == 0
    report = imported(tmp_path / "bag", bag)
    assert (report.accepted, report.rejected) == (drive.pictures, 0)
    assert envelopes(tmp_path / "bag") == envelopes(tmp_path / "lines")
    for settings in rules:
        assert digest(tmp_path / "bag", *settings) == digest(tmp_path / "lines", *settings)


@pytest.mark.parametrize(
    "form",
    [
        "mcap none",
        "sqlite none",
        pytest.param("sqlite file", marks=pytest.mark.slow),
        "sqlite message",
    ],
)
def test_a_bag_gives_the_map_of_the_same_detections_as_json_lines(
    form: str, drives: dict[str, Path], tmp_path: Path
) -> None:
    same_map_as_json_lines(DRIVE, drives[form], tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("storage", ["mcap", "sqlite"])
def test_ten_thousand_messages_give_the_map_of_json_lines(storage: str, tmp_path: Path) -> None:
    drive = Drive(10_000)
    bag = write_bag(tmp_path / "drive", drive.messages(), storage)
    same_map_as_json_lines(drive, bag, tmp_path, ((),))


def test_the_report_says_what_was_used_and_what_was_not(
    drives: dict[str, Path], tmp_path: Path
) -> None:
    picture = Raw("sensor_msgs/msg/Image", b"\0\1\0\0")
    bag = write_bag(tmp_path / "drive", [*DRIVE.messages(), ("/image", START, picture)])
    report = imported(tmp_path / "log", bag)
    (about,) = report.bags
    assert {topic.topic: topic.used_for for topic in about.topics} == {
        "/camera_info": "camera",
        "/detections": f"keyframes of run {RUN}",
        "/embeddings": "embeddings",
        "/image": "",
        "/tf": "poses of base_link in map",
        "/tf_static": "where the camera is",
    }
    assert (report.skipped, about.messages) == (1, 40 * 2 + 42 + 3)
    assert about.frames == {"/detections": "map"}
    counts = about.streams["/detections"]
    assert (counts.keyframes, counts.without_pose, counts.without_covariance) == (40, 0, 40)
    assert (
        counts.detections
        == counts.with_embedding
        == sum(len(each["detections"]) for each in envelopes(tmp_path / "log"))
    )
    assert (counts.unused, about.notes, about.is_useless) == ({}, [], False)


@pytest.mark.parametrize("own", ["/mapfold/objects", "/bot1/mapfold/objects"])
def test_things_in_three_dimensions_have_positions_and_what_mapfold_shows_is_no_input(
    tmp_path: Path, own: str
) -> None:
    seen = ros.solids(START, "map", ros.solid("chair", flat(2.0, 1.0, 0.0, 0.4), 0.5, 0.6, 0.9))
    shown = (own, START, seen)
    tree = ros.tf(ros.transform("map", "base_link", START, flat(0.0, 0.0, 0.0)))
    recorded = [("/tf", START, tree), shown, ("/things", START, seen)]
    bag = write_bag(tmp_path / "drive", recorded)
    (about,) = imported(tmp_path / "log", bag).bags
    assert {t.topic for t in about.topics if not t.used_for} == {own}
    assert about.streams["/things"].with_position == 1
    ((chair,),) = (each["detections"] for each in envelopes(tmp_path / "log"))
    assert (chair["position"], chair["position_z"]) == ([2.0, 1.0], 0.4)
    assert chair["size"] == [0.6, 0.5, 0.9]
    flat_too = [*recorded, ("/detections", START, ros.detections(START, "map"))]
    (about,) = imported(tmp_path / "other", write_bag(tmp_path / "again", flat_too)).bags
    assert list(about.streams) == ["/detections"]


def test_scans_give_walls_where_the_bag_has_no_map(tmp_path: Path) -> None:
    ranges = [1.5, 2.0, math.inf, 3.0] * 90
    recorded: list[Any] = []
    for number in range(12):
        at = START + number * SECOND // 5
        links = [
            ros.transform("map", "base_link", at, flat(0.1 * number, 0.0, 0.0)),
            ros.transform("base_link", "laser", at, flat(0.1, 0.0, 0.0)),
        ]
        seen = ros.detections(at, "base_link", ros.detection([("cup", 0.9)], ros.box(9, 9, 2, 2)))
        scan = ros.laser_scan(at, "laser", ranges, angle_min=0.0, angle_increment=0.0174)
        recorded += [("/tf", at, ros.tf(*links)), ("/scan", at, scan), ("/detections", at, seen)]
    bag = write_bag(tmp_path / "drive", recorded)
    (about,) = imported(tmp_path / "log", bag).bags
    used = {topic.topic: topic.used_for for topic in about.topics}
    assert used["/scan"] == "walls"
    assert about.streams["/detections"].with_scan == 12
    assert all("scan" in each for each in envelopes(tmp_path / "log"))
    with LogReader(tmp_path / "log") as reader:
        _, view = fold_log(reader, Settings(places="rooms"))
    assert view.map is not None
    assert view.map.scanned
    with_map = [*recorded, ("/map", START, Raw("nav_msgs/msg/OccupancyGrid", b"\0\1\0\0"))]
    (about,) = imported(tmp_path / "other", write_bag(tmp_path / "again", with_map)).bags
    assert not any(topic.used_for for topic in about.topics if topic.topic == "/scan")


def test_a_second_import_changes_no_map(drives: dict[str, Path], tmp_path: Path) -> None:
    log = tmp_path / "log"
    imported(log, drives["mcap none"])
    before = digest(log)
    (file,) = drives["sqlite none"].glob("*.db3")
    part = tmp_path / "drive_0.db3"  # as rosbag2 names the first file of the bag drive
    shutil.copy(file, part)
    assert imported(log, drives["mcap none"], part).accepted == 2 * DRIVE.pictures
    assert digest(log) == before


def test_events_are_logged_when_the_bag_received_them(
    drives: dict[str, Path], tmp_path: Path
) -> None:
    imported(tmp_path / "log", drives["sqlite none"])
    for number, event in enumerate(read_log(tmp_path / "log")):
        assert event.logged_ns == event.stamp_ns == DRIVE.shown_at(number)
        assert event.key == "tb/detections"


def test_a_bag_of_two_robots_gives_a_run_of_each(tmp_path: Path) -> None:
    robots = [Drive(10, seed=seed, prefix=f"/robot{seed}") for seed in (1, 2)]
    order = count()
    messages = sorted(
        (received, next(order), topic, message)
        for robot in robots
        for topic, received, message in robot.messages()
    )
    bag = write_bag(tmp_path / "drive", [(t, r, m) for r, _, t, m in messages])
    report = imported(tmp_path / "log", bag)
    assert (report.accepted, report.bags[0].notes) == (20, [])
    for seed, robot in enumerate(robots, 1):
        run_id = f"{RUN}:robot{seed}"
        found = [each for each in envelopes(tmp_path / "log") if each["run_id"] == run_id]
        assert found == [json.loads(each) for each in robot.envelopes(run_id)]


def test_files_of_a_split_bag_are_read_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    messages = [*DRIVE.messages()]
    bag = tmp_path / "drive"
    bag.mkdir()
    for number, at in enumerate(range(0, len(messages), 11)):
        part = write_bag(tmp_path / f"part{number}", messages[at : at + 11])
        (file,) = part.glob("*.mcap")
        file.rename(bag / f"drive_{number}.mcap")  # without a metadata.yaml
    assert len([*bag.iterdir()]) > 10
    imported(tmp_path / "log", bag)
    assert envelopes(tmp_path / "log") == [json.loads(each) for each in DRIVE.envelopes(RUN)]


def grid_and_detections(*grids: tuple[str, int, Any]) -> list[tuple[str, int, Any]]:
    return sorted([*DRIVE.messages(), *grids], key=lambda each: each[1])


def test_an_occupancy_grid_becomes_a_map_once_for_as_long_as_it_stays(tmp_path: Path) -> None:
    cells = [0, 100, -1, 0, 0, 100]
    at = [DRIVE.stamp(number) + 1 for number in (10, 20, 30)]
    grids = [
        ("/map", at[0], ros.grid(at[0], cells, 3, 2)),
        ("/map", at[1], ros.grid(at[1], cells, 3, 2)),
        ("/map", at[2], ros.grid(at[2], cells[::-1], 3, 2)),
        ("/costmap/costmap", at[0], ros.grid(at[0], cells, 2, 3)),
        ("/map", at[2], Raw("nav_msgs/msg/OccupancyGrid", b"\0\1\0\0short")),
    ]
    bag = write_bag(tmp_path / "drive", grid_and_detections(*grids))
    report = imported(tmp_path / "log", bag)
    assert (report.maps, report.accepted, report.rejected) == (2, DRIVE.pictures, 1)
    assert report.bags[0].unchanged_grids == 1
    keys = [event.key for event in read_log(tmp_path / "log")]
    assert keys.index("mapfold/map") == 10, "between the keyframes that it was received between"
    given = imported(tmp_path / "other", bag, grid="/costmap/costmap")
    assert (given.maps, given.rejected) == (1, 0)
    assert imported(tmp_path / "none", bag, grid="none").maps == 0


def test_costmaps_are_not_taken_for_the_map(tmp_path: Path) -> None:
    grid = ("/local_costmap/costmap", START + 1, ros.grid(START, [0], 1, 1))
    bag = write_bag(tmp_path / "drive", grid_and_detections(grid))
    report = imported(tmp_path / "log", bag)
    assert report.maps == 0
    assert "--grid" in report.bags[0].notes[0]


def test_without_transforms_poses_come_from_the_localiser_else_from_odometry(
    tmp_path: Path,
) -> None:
    covariance = ros.six_by_six(0.04, 0.0, 0.04, 0.01)
    messages: list[tuple[str, int, Any]] = [
        ("/detections", START + 50, ros.detections(START + 50, "camera"))
    ]
    for at in (START, START + 100):
        odometry = ros.odometry(at, "odom", "base", flat(1.0, 0.0, 0.0))
        messages.append(("/odom", at, odometry))
        for topic, x in (("/amcl_pose", 2.0), ("/initialpose", 3.0)):
            pose = ros.pose_with_covariance(at, "map", flat(x, 0.0, 0.0), covariance)
            messages.append((topic, at, pose))
    messages.sort(key=lambda each: each[1])
    both = write_bag(tmp_path / "both", messages)
    odometry_only = write_bag(
        tmp_path / "odometry", [m for m in messages if m[0] in ("/odom", "/detections")]
    )
    imported(tmp_path / "a", both)
    imported(tmp_path / "b", odometry_only)
    imported(tmp_path / "c", both, pose="/odom", run_id="mine")
    imported(tmp_path / "d", both, pose="none")
    (a,), (b,), (c,), (d,) = (envelopes(tmp_path / name) for name in "abcd")
    assert (a["map_x"], a["pose_covariance"][0]) == (2.0, 0.04)
    assert (b["map_x"], "pose_covariance" in b) == (1.0, False)
    assert (c["map_x"], c["run_id"]) == (1.0, "mine")
    assert "map_x" not in d


def test_frames_are_found_under_other_names(tmp_path: Path) -> None:
    messages: list[tuple[str, int, Any]] = [
        ("/detections", START + 50, ros.detections(START + 50, "r1/eye"))
    ]
    mount = ros.tf(ros.transform("r1/base_footprint", "r1/eye", 0, flat(0.5, 0.0, 0.0)))
    messages.append(("/tf_static", START, mount))
    for at in (START, START + 100):
        link = ros.transform("r1/odom", "r1/base_footprint", at, flat(1.0, 0.0, 0.0))
        messages.append(("/tf", at, ros.tf(link)))
    messages.sort(key=lambda each: each[1])
    report = imported(tmp_path / "log", write_bag(tmp_path / "drive", messages))
    ((made,), (about,)) = envelopes(tmp_path / "log"), report.bags
    assert made["map_x"] == 1.5
    assert any("'r1/odom'" in note and "drifts" in note for note in about.notes)
    assert about.streams["/detections"].without_base_frame == 0


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"detections": ("/nothing",)}, "no messages of that topic"),
        ({"detections": ("/tf",)}, "or vision_msgs/msg/Detection3DArray; of that type it has /d"),
        ({"pose": "/odom"}, "it has none of that type"),
        ({"embeddings": "/tf"}, "std_msgs/msg/String"),
        ({"camera": "/x"}, "--camera /x"),
        ({"grid": "/x"}, "--grid /x"),
        ({"covariance": "/x"}, "--covariance /x"),
    ],
)
def test_an_option_that_fits_nothing_says_what_there_is(
    options: dict[str, Any], said: str, drives: dict[str, Path], tmp_path: Path
) -> None:
    with pytest.raises(MisuseError, match=said):
        imported(tmp_path / "log", drives["mcap none"], **options)


def test_what_is_switched_off_is_not_said_to_be_missing(
    drives: dict[str, Path], tmp_path: Path
) -> None:
    report = imported(tmp_path / "log", drives["mcap none"], pose="none", embeddings="none")
    about = report.bags[0]
    counts = about.streams["/detections"]
    assert (counts.without_pose, counts.with_embedding) == (counts.keyframes, 0)
    assert about.notes == []


def test_a_bag_without_detections_says_so(tmp_path: Path) -> None:
    only_tf = [each for each in DRIVE.messages() if each[0] == "/tf"]
    for name, messages, said in (
        ("drive", only_tf, "it has tf2_msgs/msg/TFMessage"),
        ("empty", [], "it is empty"),
    ):
        for storage in ("mcap", "sqlite"):
            bag = write_bag(tmp_path / storage / name, messages, storage)
            report = imported(tmp_path / "log", bag)
            assert (report.first_offset, report.bags[0].is_useless) == (report.next_offset, True)
            assert said in report.bags[0].notes[-1]


# The command


def test_the_command_says_what_it_took_for_what(mapfold: Commands) -> None:
    messages = [*Drive(3).messages()]
    other = [(f"/other{n:02}", START, ros.text("x")) for n in range(12)]
    write_bag(mapfold.folder / "drive", [*messages, *other], "sqlite")
    said = mapfold("import", "log", "drive")
    lines = said.err.splitlines()
    assert lines[0] == "drive: 25 messages of 17 topics, 0.4 s"
    assert [line.split() for line in lines[1:3]] == [
        ["/camera_info", "1", "sensor_msgs/msg/CameraInfo:", "camera"],
        ["/detections", "3", "vision_msgs/msg/Detection2DArray:", "keyframes", "of", "run", RUN],
    ]
    assert "  … and 2 more topics that are not used" in lines
    assert lines[-1].startswith("imported 3 envelopes into log, offsets 0 to 3, 12 messages")
    assert lines[-2] == "log: a new log with --preset full, for input of ROS, said at offset 0"
    document = mapfold("import", "other", "drive", "--json").json
    assert document["bags"][0]["streams"]["/detections"]["keyframes"] == 3
    assert document["accepted"] == 3


def test_a_bag_that_is_imported_again_adds_nothing_and_a_longer_one_what_is_new(
    mapfold: Commands,
) -> None:
    grid = ("/map", START + 1, ros.grid(START, [0, 100], 2, 1))
    write_bag(mapfold.folder / "drive", [grid, *Drive(3).messages()])
    mapfold("import", "log", "drive")
    events = read_log(mapfold.folder / "log")
    said = mapfold("import", "log", "drive").err
    assert "imported 0 envelopes into log, 4 messages passed over, 0 rejected" in said
    assert "passed over: map: 1 message, in the log already" in said
    assert read_log(mapfold.folder / "log") == events
    longer = write_bag(mapfold.folder / "longer", [grid, *Drive(5).messages()])
    said = mapfold("import", "log", longer, "--run-id", RUN).err
    assert "imported 2 envelopes into log, offsets 5 to 6, 4 messages passed over" in said
    assert "nothing is new" not in said


def test_the_command_exits_with_3_for_nothing_and_2_for_a_wrong_option(mapfold: Commands) -> None:
    write_bag(mapfold.folder / "empty", [])
    said = mapfold("import", "log", "empty", code=3)
    assert "note: nothing to import: no topic is of type" in said.err
    write_bag(mapfold.folder / "drive", Drive(2).messages())
    wrong = [
        (["--detections", "/x"], "--detections /x"),
        (["--topic", "/detections"], "--topic does not choose what is used of a bag"),
        (["--max-gap", "0"], "--max-gap 0"),
        (["--max-gap", "nan"], "--max-gap nan"),
        (["--run-id", ""], "--run-id"),
        (["--labels", "none.txt"], "--labels none.txt: No such file"),
    ]
    for options, told in every_other(wrong):
        assert told in mapfold("import", "log", "drive", *options, code=2).err


@pytest.mark.parametrize("topic", mostly_slow(["/label_info", "/far/label_info"]))
def test_numbered_classes_get_the_names_of_a_label_info(mapfold: Commands, topic: str) -> None:
    seen = [ros.detection([(name, 0.9)], ros.box(9, 9, 2, 2)) for name in ("0", "17", "7")]
    shown = ("/detections", START, ros.detections(START, "camera", *seen))
    told = (topic, START + 5, ros.label_info(START, {0: "person", 17: "chair", 7: ""}))
    write_bag(mapfold.folder / "drive", [shown, told])
    said = mapfold("import", "log", "drive").err
    assert f"{topic} " in said
    assert "vision_msgs/msg/LabelInfo: names of classes" in said
    (made,) = envelopes(mapfold.folder / "log")
    assert [each["class"] for each in made["detections"]] == ["person", "chair", "7"]
    (mapfold.folder / "names.json").write_text('{"17": "stool", "7": "bicycle"}')
    mapfold("import", "other", "drive", "--labels", "names.json")
    (made,) = envelopes(mapfold.folder / "other")
    assert [each["class"] for each in made["detections"]] == ["person", "stool", "bicycle"]
    said = mapfold("import", "log", "drive", "--labels", "names.json").err
    assert "nothing is new: the first recording of a keyframe counts, so only other" in said
    assert "`mapfold edit log relabel --labels FILE` names its classes" in said


def test_numbered_classes_get_the_names_of_a_parameter(mapfold: Commands) -> None:
    seen = [ros.detection([(name, 0.9)], ros.box(9, 9, 2, 2)) for name in ("0", "2", "7")]
    shown = ("/detections", START, ros.detections(START, "camera", *seen))
    names = ["person", "bicycle", "chair"]
    others = [ros.parameter_event(f"/node{n}", {"rate": n, "frame": "map"}) for n in range(20)]
    others.append(ros.parameter_event("/yolo", {"weights_info": names}))
    events = [("/parameter_events", START + n, each) for n, each in enumerate(others)]
    info = ("/vision_info", START + 99, ros.vision_info(START, "/yolo/weights_info"))
    write_bag(mapfold.folder / "drive", [shown, *events, info], "sqlite")
    said = mapfold("import", "log", "drive").err
    assert "rcl_interfaces/msg/ParameterEvent: names of classes by weights_info of /yolo" in said
    assert "3 detections, 0 with an embedding; 1 with a number as the class" in said
    (made,) = envelopes(mapfold.folder / "log")
    assert [each["class"] for each in made["detections"]] == ["person", "chair", "7"]
    write_bag(mapfold.folder / "other", [shown, info])
    said = mapfold("import", "of-file", "other").err
    assert "note: /detections: no parameter '/yolo/weights_info', which a VisionInfo nam" in said
    mapfold("import", "none", "drive", "--classes", "none")
    (made,) = envelopes(mapfold.folder / "none")
    assert [each["class"] for each in made["detections"]] == ["0", "2", "7"]
    wrong = mapfold("import", "no", "drive", "--classes", "/detections", code=2).err
    assert "--classes /detections: it is of type vision_msgs/msg/Detection2DArray, not" in wrong


def test_a_label_info_that_cannot_be_read_names_nothing(mapfold: Commands) -> None:
    seen = ros.detection([("17", 0.9)], ros.box(9, 9, 2, 2))
    shown = ("/detections", START, ros.detections(START, "camera", seen))
    short = Raw("vision_msgs/msg/LabelInfo", b"\0\1\0\0\xff")
    write_bag(mapfold.folder / "drive", [shown, ("/label_info", START, short)])
    mapfold("import", "log", "drive", code=None)
    (made,) = envelopes(mapfold.folder / "log")
    assert [each["class"] for each in made["detections"]] == ["17"]


def test_numbered_classes_get_the_names_of_a_file(mapfold: Commands) -> None:
    seen = [ros.detection([(name, 0.9)], ros.box(9, 9, 2, 2)) for name in ("0", "2", "7")]
    shown = ("/detections", START, ros.detections(START, "camera", *seen))
    write_bag(mapfold.folder / "drive", [shown])
    (mapfold.folder / "names.txt").write_text("person\n\nbicycle \n")
    mapfold("import", "log", "drive", "--labels", "names.txt")
    (made,) = envelopes(mapfold.folder / "log")
    assert [each["class"] for each in made["detections"]] == ["person", "bicycle", "7"]
