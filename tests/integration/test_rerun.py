"""The map for the Rerun viewer: what the recording shows at each moment, against the state then."""

import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from eventsrc.base.errors import MisuseError
from eventsrc.envelope.model import Offset
from eventsrc.log import LogReader
from projections.adapters.scene import place_colour
from projections.fold.settings import Settings
from projections.map.fold import RecordedFold
from projections.surfaces.cli.export_command import _recorder
from tests.support.commands import Commands
from tests.support.envelopes import detection, envelope
from tests.support.logs import sample_drive, write_log
from tests.support.maps import write_map_yaml

SAMPLE = sample_drive()
SETTINGS = Settings(eps_m=0.75, min_samples=8)
ROOMS = ("--set", "eps_m=0.75", "--set", "min_samples=8")
RERUN = Path(sys.executable).with_name("rerun")
Row = dict[str, Any]


class Recording:
    """The rows of each entity, ordered by offset; those of one moment in the order of the file."""

    def __init__(self, path: Path) -> None:
        self.entities: dict[str, list[Row]] = {}
        self.static: dict[str, list[Row]] = {}
        from rerun.chunk import RrdReader  # here: no other test needs what takes half a second

        reader = RrdReader(str(path))
        assert [store.application_id for store in reader.recordings()] == ["mapfold"]
        for chunk in reader.stream():
            kept = self.static if chunk.is_static else self.entities
            rows = chunk.to_record_batch().to_pylist()
            kept.setdefault(str(chunk.entity_path), []).extend(rows)
        for rows in self.entities.values():
            rows.sort(key=lambda row: row["offset"])

    def at(self, entity: str, end: int) -> Row:
        """What the viewer shows of an entity at an offset: the latest value of each component."""
        found: Row = {}
        for row in self.entities.get(entity, ()):
            if row["offset"] <= end:
                if row.get("Clear:is_recursive") is not None:
                    found.clear()
                found |= {name: value for name, value in row.items() if value is not None}
        return found


def rrd(command: str, *arguments: str | Path, home: Path) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [RERUN, "rrd", command, *arguments],
        env=os.environ | {"HOME": str(home), "XDG_CONFIG_HOME": str(home)},
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )


def record(log: Path, path: Path, *, every: int | None = None, end: int | None = None) -> int:
    from projections.adapters.rerun.rrd_recording import (
        write_recording,  # takes half a second to import
    )

    with LogReader(log) as reader:
        until = reader.next_offset if end is None else Offset(end)
        return write_recording(RecordedFold(reader, SETTINGS, until, every=every), path, "test")


@pytest.fixture
def mapfold(tmp_path: Path) -> Commands:
    return Commands.in_folder(tmp_path)


def colours(numbers: list[int]) -> list[str]:
    return [f"#{number >> 8:06x}" for number in numbers]


@pytest.mark.seconds
def test_the_recording_shows_the_map_of_each_moment(mapfold: Commands) -> None:
    said = mapfold("export", SAMPLE, "--rerun", "m.rrd", "--every", "50", *ROOMS).err
    merges = mapfold("merges", SAMPLE, "--json", *ROOMS).json
    at = sorted({*range(50, 445, 50), 445, *(merge["offset"] + 1 for merge in merges)})
    assert said == f"wrote m.rrd: 445 events, {len(at)} scenes\n"
    verified = rrd("verify", mapfold.folder / "m.rrd", home=mapfold.folder)
    assert verified.returncode == 0, verified.stderr
    assert "1 file verified without error" in verified.stdout + verified.stderr
    recorded = Recording(mapfold.folder / "m.rrd")
    for end in (at[0], at[len(at) // 2], 445):
        state = mapfold("state", SAMPLE, "--at", str(end), "--json", *ROOMS).json
        _compare(recorded, state, end)
    counts = [recorded.entities[f"/counts/{name}"] for name in ("places", "objects")]
    assert [row["offset"] for row in counts[0]] == list(range(1, 446))
    assert [rows[-1]["Scalars:scalars"] for rows in counts] == [
        [len(state["places"])],
        [len(state["objects"])],
    ]
    with LogReader(SAMPLE) as reader:
        lags = [(event.logged_ns - event.stamp_ns) / 1e9 for event in reader.read()]
    assert [row["Scalars:scalars"] for row in recorded.entities["/lag"]] == [[lag] for lag in lags]
    lines = [row["TextLog:text"][0] for row in recorded.entities["/changes"]]
    for merge in merges:
        told = f"place {', '.join(merge['absorbed'])} merged into {merge['survivor']}"
        assert any(line.startswith(told) for line in lines)


def _compare(recorded: Recording, state: dict[str, Any], end: int) -> None:
    """An offset's map against ``state --json`` of it."""
    places, objects = state["places"], [o for o in state["objects"] if o["confirmed"]]
    shown = recorded.at("/map/places", end)
    assert [label.rpartition("(")[2].rstrip(")") for label in shown["Points2D:labels"]] == [
        place["place_id"] for place in places
    ]
    _near(shown["Points2D:positions"], [(p["centroid_x"], p["centroid_y"]) for p in places])
    shown = recorded.at("/map/objects", end)
    assert shown["Points2D:labels"] == [found["class_name"] for found in objects]
    _near(shown["Points2D:positions"], [(o["mean_x"], o["mean_y"]) for o in objects])
    graph = recorded.at("/graph", end)
    nodes = [f"place/{place['place_id']}" for place in places]
    nodes += [f"object/{found['object_id']}" for found in objects]
    assert graph["GraphNodes:node_ids"] == nodes
    edges = {(edge["first"], edge["second"]) for edge in graph["GraphEdges:edges"]}
    assert edges == {
        *((f"place/{e['a']}", f"place/{e['b']}") for e in state["adjacency"]),
        *((f"object/{o['object_id']}", f"place/{o['place_id']}") for o in objects if o["place_id"]),
    }
    posed = [k for k in state["keyframes"] if k["map_x"] is not None]
    robot = recorded.at("/map/robot", end)
    _near(robot["Arrows2D:origins"], [(posed[-1]["map_x"], posed[-1]["map_y"])])
    assert len(recorded.at("/map/keyframes", end)["Points2D:positions"]) == len(posed)


def _near(shown: list[list[float]], expected: list[tuple[float, float]]) -> None:
    """Equal to what 32-bit floats can hold."""
    assert len(shown) == len(expected)
    for (x, y), (to_x, to_y) in zip(shown, expected, strict=True):
        assert math.isclose(x, to_x, abs_tol=1e-5)
        assert math.isclose(y, to_y, abs_tol=1e-5)


@pytest.mark.slow
@pytest.mark.seconds
def test_two_recordings_hold_the_same_data(tmp_path: Path) -> None:
    for name in ("a.rrd", "b.rrd"):
        record(SAMPLE, tmp_path / name, end=60)
    record(SAMPLE, tmp_path / "c.rrd", end=59)
    files = [tmp_path / name for name in ("a.rrd", "b.rrd", "c.rrd")]
    same = rrd("compare", "--unordered", files[0], files[1], home=tmp_path)
    assert same.returncode == 0, same.stderr[:2000]
    assert rrd("compare", "--unordered", files[0], files[2], home=tmp_path).returncode != 0
    assert not list(tmp_path.glob("*.partial"))


def test_floors_are_apart_and_walls_are_drawn(tmp_path: Path, mapfold: Commands) -> None:
    hostile = "a b/c"
    frames = [
        *(
            envelope(k, 0.1 * k, 1.0, floor="1", detections=[detection("cup", [1.0])])
            for k in range(9)
        ),
        *(envelope(k, 0.1 * k, 2.0, floor=hostile) for k in range(9, 18)),
    ]
    log = write_log(tmp_path / "log", frames)
    path = write_map_yaml(tmp_path, "####\n#..#\n####", resolution=0.5, origin=[-1.0, -0.5, 0.0])
    mapfold("import", log, "--map", path)
    assert record(log, tmp_path / "m.rrd", every=1) == 19
    recorded = Recording(tmp_path / "m.rrd")
    upper = "/floors/a\\ b\\/c"
    assert {name for name in recorded.entities if name.startswith("/floors")} >= {
        "/floors/1/places",
        "/floors/1/walls",
        f"{upper}/places",
    }, recorded.entities.keys()
    assert recorded.at("/floors/1/robot", 9)
    assert not recorded.at("/floors/1/robot", 10).get("Arrows2D:origins"), "it went up"
    assert recorded.at(f"{upper}/robot", 10)
    assert not recorded.at("/floors/1/walls", 18).get("LineStrips2D:strips")
    assert len(recorded.at("/floors/1/walls", 19)["LineStrips2D:strips"]) == 8
    placed = recorded.at("/floors/1/places", 18)
    assert colours(placed["Points2D:colors"]) == [place_colour(0)]


def test_an_empty_log_and_one_of_odd_poses_are_recorded(tmp_path: Path) -> None:
    assert record(write_log(tmp_path / "none", []), tmp_path / "none.rrd") == 0
    frames = [
        envelope(0),
        envelope(1, 1e6, -1e6, timestamp=0.0, detections=[detection("tasse ☕/", [1.0])]),
    ]
    assert record(write_log(tmp_path / "odd", frames), tmp_path / "odd.rrd") == 2
    _near(Recording(tmp_path / "odd.rrd").at("/map/robot", 2)["Arrows2D:origins"], [(1e6, -1e6)])


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--rerun", "m.rrd", "--floor", "a"), "--rerun shows all floors"),
        (("--rerun", "file/m.rrd"), "file/m.rrd: cannot be written: "),
        pytest.param(
            *(("--rerun", "folder"), "folder: cannot be written: Is a directory"),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_what_cannot_be_recorded_is_said(
    mapfold: Commands, options: tuple[str, ...], says: str
) -> None:
    (mapfold.folder / "file").touch()
    (mapfold.folder / "folder").mkdir()
    log = write_log(mapfold.folder / "log", [envelope(0), envelope(1)])
    assert says in mapfold("export", log, *options, code=2).err
    assert not list(mapfold.folder.glob("*.partial"))


def test_without_the_extra_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    monkeypatch.delitem(sys.modules, "projections.adapters.rerun.rrd_recording", raising=False)
    monkeypatch.delattr("projections.adapters.rerun.rrd_recording", raising=False)
    with pytest.raises(MisuseError, match=r"--rerun needs rerun.*pip install 'mapfold\[rerun\]'"):
        _recorder("rerun", "")


def test_an_interrupted_recording_ends_and_leaves_no_file(tmp_path: Path) -> None:
    from projections.adapters.rerun.rrd_recording import write_recording

    def interrupt(offset: int, _: int) -> None:
        if offset == 300:
            raise KeyboardInterrupt

    with LogReader(SAMPLE) as reader:
        fold = RecordedFold(reader, SETTINGS, reader.next_offset, progress=interrupt)
        with pytest.raises(KeyboardInterrupt):
            write_recording(fold, tmp_path / "map.rrd", "test")
    assert [*tmp_path.iterdir()] == []
