"""`mapfold export`: files of the map at a moment, under settings, on a floor."""

import csv
import json
from pathlib import Path

import pytest
import yaml

from tests.support.commands import Commands
from tests.support.envelopes import detection, envelope
from tests.support.logs import write_log

ALL = ("--graphml", "m.graphml", "--dot", "m.dot", "--geojson", "m.json", "--csv", "t", "--nav2")


@pytest.fixture
def mapfold(tmp_path: Path) -> Commands:
    return Commands.in_folder(tmp_path)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """Two rooms of five poses, a cup in each; the second is on another floor."""
    documents = [
        envelope(
            k,
            0.3 * (k % 5) + 10 * (k // 5),
            0.1 * (k % 2),
            floor="ground" if k < 5 else "first",
            detections=[detection("cup", [1.0, 0.0] if k < 5 else [0.0, 1.0])],
        )
        for k in range(10)
    ]
    return write_log(tmp_path / "log", documents)


def written(folder: Path) -> dict[str, bytes]:
    files = [*folder.glob("m.*"), *folder.glob("t/*.csv")]
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}


def test_all_formats_at_once_hold_the_map_of_state(mapfold: Commands, log: Path) -> None:
    import networkx

    said = mapfold("export", log, *ALL, "m.yaml").err
    assert said == (
        "wrote m.graphml, m.dot, m.json, m.yaml, t/places.csv, t/objects.csv, t/keyframes.csv,"
        " t/adjacency.csv: 2 places, 2 objects\n"
    )
    state = mapfold("state", log, "--json").json
    places = {p["place_id"]: (p["centroid_x"], p["centroid_y"]) for p in state["places"]}
    folder = mapfold.folder
    graph = networkx.read_graphml(folder / "m.graphml")
    assert {n: (v["x"], v["y"]) for n, v in graph.nodes(data=True) if v["kind"] == "Place"} == (
        places
    )
    with (folder / "t/places.csv").open(newline="") as table:
        rows = list(csv.DictReader(table))
    assert {r["place_id"]: (float(r["centroid_x"]), float(r["centroid_y"])) for r in rows} == places
    waypoints = yaml.safe_load((folder / "m.yaml").read_text())["waypoints"]
    assert {name: tuple(w["pose"][:2]) for name, w in waypoints.items()} == places
    features = json.loads((folder / "m.json").read_text())["features"]
    assert [f["properties"]["kind"] for f in features].count("place") == 2


def test_the_same_log_gives_the_same_bytes(mapfold: Commands, log: Path) -> None:
    mapfold("export", log, *ALL, "m.yaml")
    first = written(mapfold.folder)
    assert len(first) == 8
    mapfold("export", log, *ALL, "m.yaml")
    assert written(mapfold.folder) == first


def test_a_moment_a_floor_and_settings(mapfold: Commands, log: Path) -> None:
    def places(*options: str) -> list[str]:
        mapfold("export", log, "--nav2", "m.yaml", *options)
        return list(yaml.safe_load((mapfold.folder / "m.yaml").read_text())["waypoints"])

    both = places()
    assert len(both) == 2
    assert places("--at", "5") == both[:1]
    assert places("--floor", "first") == both[1:]
    assert places("--set", "min_samples=9") == []


def test_the_scene_graph_has_each_object_in_a_pose_of_its_place(
    mapfold: Commands, log: Path
) -> None:
    run = "export", log, "--preset", "full", "--set", "min_samples=3", "--dsg"
    mapfold(*run, "m.dsg")
    graph = json.loads((mapfold.folder / "m.dsg").read_text())
    nodes = {node["id"]: node for node in graph["nodes"]}
    named = {node["attributes"]["type"] for node in nodes.values()}
    assert named == {f"{kind}NodeAttributes" for kind in ("Room", "Place", "Object")}
    layers = [(nodes[e["source"]]["layer"], nodes[e["target"]]["layer"]) for e in graph["edges"]]
    objects = [node for node in nodes.values() if node["layer"] == 2]
    assert layers.count((3, 2)) == len(objects) > 0
    assert layers.count((4, 3)) == sum(node["layer"] == 3 for node in nodes.values())
    first = written(mapfold.folder)["m.dsg"]
    mapfold(*run, "m.dsg")
    assert written(mapfold.folder)["m.dsg"] == first


def test_an_origin_places_the_map_on_earth(mapfold: Commands, log: Path) -> None:
    mapfold("export", log, "--geojson", "m.json", "--origin", "52.52,13.405,90")
    features = json.loads((mapfold.folder / "m.json").read_text())["features"]
    (path,) = (f["geometry"]["coordinates"] for f in features if f["properties"]["kind"] == "run")
    assert path[0] == pytest.approx([13.405, 52.52])
    # 10 m along x, which points north: a degree of latitude is 111.27 km there
    assert path[5] == pytest.approx([13.405 - 0.1 / 67_900, 52.52 + 10 / 111_270], abs=2e-8)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ((), "nothing to write; give at least one of --graphml, --dot, --geojson, --csv, --nav2"),
        (("--dot", "m.dot", "--origin", "1,2"), "--origin is for --geojson"),
        (("--geojson", "m.json", "--origin", "Berlin"), "--origin Berlin: write it as LAT,LON"),
        (("--geojson", "m.json", "--origin", "1,nan"), "--origin 1,nan: write it as LAT,LON"),
        (("--geojson", "m.json", "--origin", "95,2"), "give a latitude of -89 to 89"),
        (("--dot", "file/m.dot"), "file/m.dot: cannot be written: File exists; choose another"),
        (
            ("--csv", "file/t"),
            "file/t/places.csv: cannot be written: Not a directory; choose another",
        ),
        (("--dot", "m.dot", "--floor", "roof"), "no floor 'roof' in this map"),
    ],
)
def test_an_output_that_cannot_be_written_is_an_error(
    mapfold: Commands, log: Path, options: tuple[str, ...], says: str
) -> None:
    (mapfold.folder / "file").touch()
    said = mapfold("export", log, *options, code=2)
    assert says in said.err
    assert not written(mapfold.folder)


def test_an_empty_log_gives_empty_files(mapfold: Commands, tmp_path: Path) -> None:
    import networkx

    write_log(tmp_path / "log", [])
    mapfold("export", "log", *ALL, "m.yaml")
    assert yaml.safe_load((tmp_path / "m.yaml").read_text()) == {"waypoints": {}}
    assert not networkx.read_graphml(tmp_path / "m.graphml")
    assert json.loads((tmp_path / "m.json").read_text())["features"] == []
    assert (tmp_path / "t/adjacency.csv").read_text() == "a,b,shared_transitions\n"
