"""Maps on their way into a log: from a map.yaml, from messages, from another log, over Zenoh."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

from eventsrc.envelope.occupancy_map import OccupancyMapEvent, decode_map
from eventsrc.envelope.system_events import MAP_KEY, REJECTED_KEY, RejectedPayload
from eventsrc.log import LogWriter
from eventsrc.log.channels import flat_schema
from eventsrc.record.transport.session import Session
from tests.integration.test_recorder import recording
from tests.support.commands import Commands
from tests.support.envelopes import envelope, payload
from tests.support.fixtures_log import KEY, flip, read_log
from tests.support.fixtures_zenoh import DEADLINE_S, Program
from tests.support.maps import cdr_message, cells, drawn_map, grid_message, write_map_yaml

DRAWING = "##### #..?# #...#"
MESSAGE = payload(grid_message(drawn_map(DRAWING, 0.05, (1.0, 2.0, 0.0))))


@pytest.fixture
def run(tmp_path: Path) -> Commands:
    """Commands in a folder with map.yaml, map.png and drive.jsonl."""
    write_map_yaml(tmp_path, DRAWING)
    lines = [payload(envelope(k)) for k in range(3)]
    (tmp_path / "drive.jsonl").write_bytes(b"\n".join(lines))
    return Commands.in_folder(tmp_path)


def _rejected(log: Path) -> list[RejectedPayload]:
    events = (event for event in read_log(log) if event.key == REJECTED_KEY)
    return [RejectedPayload.model_validate_json(event.payload) for event in events]


def test_a_map_comes_before_the_files_given_with_it(run: Commands) -> None:
    said = run("import", "L", "drive.jsonl", "--map", "map.yaml", "--json")
    assert (said.json["maps"], said.json["accepted"], said.json["next_offset"]) == (1, 3, 4)
    assert "imported 3 envelopes into L, 1 map, offsets 0 to 3, 0 rejected" in said.err
    first, *others = read_log(run.folder / "L")
    assert first.key == MAP_KEY
    assert np.array_equal(decode_map(first.payload).cells, cells(DRAWING))
    assert {event.key for event in others} == {KEY}


def test_a_map_alone_can_be_imported_and_nothing_can_not(run: Commands) -> None:
    run("import", "L", "--map", "map.yaml")
    assert "nothing to import; give a FILE, or a map by --map" in run("import", "N", code=2).err
    assert not (run.folder / "N").exists()


def test_a_map_is_of_the_floor_that_is_given(run: Commands) -> None:
    run("import", "L", "--map", "map.yaml", "--floor", "1")
    (event,) = read_log(run.folder / "L")
    assert decode_map(event.payload).floor == "1"
    assert ", of floor 1, from map.yaml" in run("log", "cat", "L").out
    said = run("import", "N", "drive.jsonl", "--floor", "1", code=2)
    assert "--floor 1 is for a map; give one by --map, too" in said.err
    said = run("import", "N", "--map", "map.yaml", "--floor", "", code=2)
    assert "map.yaml: floor: is no floor; give an integer or a text" in said.err
    assert not (run.folder / "N").exists()


@pytest.mark.parametrize("together", [True, False])
def test_a_map_before_older_recordings_is_no_clock_that_ran_backwards(
    run: Commands, together: bool
) -> None:
    lines = [payload({"ts": 100.0 + k, "key": KEY, "payload": envelope(k)}) for k in range(3)]
    (run.folder / "old.jsonl").write_bytes(b"\n".join(lines))
    if together:
        run("import", "L", "old.jsonl", "--map", "map.yaml")
        times = [event.logged_ns for event in read_log(run.folder / "L")]
        assert times == [10**11, 10**11, 101 * 10**9, 102 * 10**9]
    else:
        run("import", "L", "--map", "map.yaml")
        run("import", "L", "old.jsonl")
    assert "all good" in run("log", "verify", "L").err
    with LogWriter(run.folder / "L") as writer:  # the clock of a drive is still watched
        writer.append(KEY, payload(envelope(3)), logged_ns=50 * 10**9)
    assert "logged_ns runs backwards" in run("log", "verify", "L", code=3).out


def test_a_bad_map_leaves_the_log_as_it_was(run: Commands) -> None:
    (run.folder / "map.png").unlink()
    said = run("import", "L", "drive.jsonl", "--map", "map.yaml", code=2)
    assert said.err == "mapfold: map.png: No such file or directory; check the path\n"
    assert not (run.folder / "L").exists()


def test_the_log_shows_a_map_in_one_line_and_finds_it_good(run: Commands) -> None:
    run("import", "L", "--map", "map.yaml")
    shown = run("log", "cat", "L").out
    assert shown.endswith(
        "mapfold/map  map map of 5 × 3 cells of 0.1 m from (0, 0), from map.yaml\n"
    )
    assert run("log", "cat", "L", "--json").lines[0]["payload"]["width"] == 5
    assert "key       mapfold/map: 1" in run("log", "info", "L").out
    assert "all good" in run("log", "verify", "L").err


def test_a_forged_map_is_a_finding_and_no_crash(run: Commands) -> None:
    with LogWriter(run.folder / "L") as writer:
        writer.append(MAP_KEY, b'{"resolution": 1}')
        writer.append(MAP_KEY, b"\x1b[2Jjunk")
    assert run("log", "cat", "L").out.count("mapfold/map") == 2
    found = run("log", "verify", "L", code=3)
    assert "mapfold/map event cannot be read: origin: required field is missing" in found.out


def test_grid_messages_of_a_logger_and_of_mcap_become_maps(run: Commands) -> None:
    record = {"ts": 5.5, "key": "robot/map", "payload": json.loads(MESSAGE)}
    bad = MESSAGE.replace(b"0.05", b"0")
    (run.folder / "a.jsonl").write_bytes(payload(record) + b"\n" + bad + b"\n" + MESSAGE)
    said = run("import", "L", "a.jsonl", code=3)
    assert "a.jsonl: line 2: rejected: resolution: Input should be greater" in said.err
    with (run.folder / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("nav_msgs/msg/OccupancyGrid", "jsonschema", b"{}")
        channel = writer.register_channel("map", "json", schema)
        writer.add_message(channel, 77, MESSAGE, 78)
        writer.finish()
    run("import", "L", "a.mcap")
    events = read_log(run.folder / "L")
    assert [event.key for event in events] == [MAP_KEY, REJECTED_KEY, MAP_KEY, MAP_KEY]
    assert [events[0].logged_ns, events[3].logged_ns] == [5_500_000_000, 77]
    maps = [decode_map(events[n].payload) for n in (0, 2, 3)]
    assert [m.source for m in maps] == ["robot/map", KEY, "map"]
    assert all(np.array_equal(m.cells, cells(DRAWING)) for m in maps)
    (kept,) = _rejected(run.folder / "L")
    assert (kept.key, kept.raw) == (KEY, bad)


def test_grids_in_cdr_of_an_mcap_file_become_maps(run: Commands) -> None:
    """As a ROS 2 bag has them; other messages in CDR are passed over."""
    given = drawn_map(DRAWING, 0.05, (1.0, 2.0, 0.5))
    good = cdr_message(given)
    with (run.folder / "bag.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        for number, (name, content) in enumerate(
            [
                ("nav_msgs/msg/OccupancyGrid", good),
                ("sensor_msgs/msg/LaserScan", good),
                ("nav_msgs/msg/OccupancyGrid", good[:-1]),
                ("nav_msgs/msg/OccupancyGrid", cdr_message(given, big=True)),
            ]
        ):
            schema = writer.register_schema(name, "ros2msg", b"")
            channel = writer.register_channel(f"/t{number}", "cdr", schema)
            writer.add_message(channel, 70 + number, content, 70)
        writer.finish()
    said = run("import", "L", "bag.mcap", code=3)
    assert (
        "rejected: neither JSON nor nav_msgs/OccupancyGrid in CDR: data would end at byte"
        in said.err
    )
    assert "2 maps" in said.err
    assert "passed over: /t1: 1 message, cdr sensor_msgs/msg/LaserScan" in said.err
    events = read_log(run.folder / "L")
    assert [event.key for event in events] == [MAP_KEY, REJECTED_KEY, MAP_KEY]
    assert {decode_map(events[n].payload).digest() for n in (0, 2)} == {given.digest()}
    assert decode_map(events[0].payload).source == "/t0"
    (kept,) = _rejected(run.folder / "L")
    assert kept.raw == good[:-1]


def test_a_map_of_another_log_is_taken_over_unchanged_or_kept_as_rejected(run: Commands) -> None:
    run("import", "A", "--map", "map.yaml")
    with LogWriter(run.folder / "A") as writer:
        writer.append(MAP_KEY, b"junk", logged_ns=9)
    said = run("import", "B", "A", code=3)
    assert "A: offset 1: rejected: the map: Invalid JSON" in said.err
    before, after = read_log(run.folder / "A"), read_log(run.folder / "B")
    assert (after[0].key, after[0].payload) == (MAP_KEY, before[0].payload)
    assert after[0].stamp_ns == before[0].stamp_ns
    (kept,) = _rejected(run.folder / "B")
    assert (kept.key, kept.raw) == (MAP_KEY, b"junk")
    assert after[1].logged_ns == 9


def test_a_map_survives_sealing_and_recovery(run: Commands) -> None:
    run("import", "L", "drive.jsonl", "--map", "map.yaml")
    before = read_log(run.folder / "L")
    (segment,) = (run.folder / "L").glob("*.mcap")
    flip(segment, segment.stat().st_size - 20)  # in the footer
    run("log", "verify", "L", code=3)
    run("log", "recover", "L", code=None)
    assert [(e.key, e.payload) for e in read_log(run.folder / "L")] == [
        (e.key, e.payload) for e in before
    ]


def test_a_segment_names_the_schema_of_maps(run: Commands) -> None:
    from mcap.reader import make_reader

    run("import", "L", "--map", "map.yaml")
    (segment,) = (run.folder / "L").glob("*.mcap")
    with segment.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        (schema,) = (s for s in summary.schemas.values() if "Map" in s.name)
    assert schema.name == "mapfold.OccupancyMapEvent"
    assert json.loads(schema.data) == flat_schema(OccupancyMapEvent)


def test_a_recorder_takes_grids_on_a_key_and_rejects_map_events_from_outside(
    connected: Callable[[], Session], publish: Callable[..., Program], tmp_path: Path
) -> None:
    event = drawn_map(DRAWING).encode()
    with recording(connected(), tmp_path / "log", ["tb/**", MAP_KEY]) as running:
        session = connected()
        for key, content in [
            ("tb/map", MESSAGE),
            ("tb/ros/map", cdr_message(drawn_map(DRAWING))),
            ("tb/ros/map", cdr_message(drawn_map(DRAWING))[:-2]),
            ("tb/detections", payload(envelope(1))),
            ("tb/map", MESSAGE.replace(b'"width": 5', b'"width": 6')),
            (MAP_KEY, event),
        ]:
            publisher = session.publisher(key)
            assert publisher.wait_for_subscriber(DEADLINE_S)
            publisher.put(content)
        running.wait_until(lambda report: report.recorded == 3 and report.rejected == 3)
        running.finish()
    events = read_log(tmp_path / "log")
    made, in_cdr = (decode_map(e.payload) for e in events if e.key == MAP_KEY)
    assert (in_cdr.source, in_cdr.digest()) == ("tb/ros/map", drawn_map(DRAWING).digest())
    assert (made.source, made.origin) == ("tb/map", (1.0, 2.0, 0.0))
    assert np.array_equal(made.cells, cells(DRAWING))
    kept = {r.key: r for r in _rejected(tmp_path / "log")}
    assert kept["tb/map"].reason == "data: 15 values, where 6 × 3 cells take 18"
    assert "in CDR: data would end at byte" in kept["tb/ros/map"].reason
    assert kept[MAP_KEY].raw == event
    assert "is reserved for mapfold's own events" in kept[MAP_KEY].reason
