"""Every format that a map is exported in holds what the map does, read back by another program."""

import csv
import io
import json
import math
import re
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml
from hypothesis import example, given
from hypothesis import strategies as st

from projections.adapters.export import Origin, dot, geojson, graphml, nav2_waypoints, tables
from projections.adapters.export.lists import NEAR_M
from projections.map.view import MapView
from tests.support.envelopes import detection, envelope
from tests.support.folds import fold

TEXTS = st.text(
    st.characters(exclude_categories=["Cs", "Cc"]), min_size=1, max_size=8
) | st.sampled_from(
    ['"', "\\", "\\n", "\u202eabc", "\u2028", "<b>&amp;", "\ufffe", "=1+1", ",;", "é😀"]
)
SPOTS = st.tuples(st.integers(0, 12), st.integers(0, 12))


@st.composite
def maps(draw: st.DrawFn) -> MapView:
    """A drive over a grid of 0.4 m, in one or two runs, past things with odd class names."""
    things = draw(st.lists(TEXTS, min_size=1, max_size=4, unique=True))
    axes = np.eye(len(things))
    documents = []
    for number, (column, row) in enumerate(draw(st.lists(SPOTS, max_size=30))):
        seen = draw(st.lists(st.integers(0, len(things) - 1), max_size=2, unique=True))
        fields: dict[str, Any] = {
            "run_id": draw(st.sampled_from(["run-a", "run-b"])),
            "detections": [detection(things[i], axes[i]) for i in seen],
            "map_yaw": draw(st.floats(-3.1, 3.1)),
        }
        documents.append(envelope(number, 0.4 * column, 0.4 * row, **fields))
    rule = draw(st.sampled_from(["page", "rooms"]))
    fusion = draw(st.sampled_from(["page", "evidence"]))
    return fold(documents, eps_m=0.6, places=rule, fusion=fusion).view


def stands(view: MapView, found: Any) -> tuple[float, float]:
    if view.settings.fusion == "page" or found.estimate is None:
        return found.mean_x, found.mean_y
    return found.estimate.est_x, found.estimate.est_y


@given(maps())
def test_graphml_read_by_networkx_has_every_place_object_and_edge(view: MapView) -> None:
    import networkx

    graph = networkx.parse_graphml(graphml(view))
    places = [node for node, v in graph.nodes(data=True) if v["kind"] == "Place"]
    objects = {node: v for node, v in graph.nodes(data=True) if v["kind"] == "Object"}
    assert places == [place.place_id for place in view.places.values()]
    assert list(objects) == [found.object_id for found in view.objects.values()]
    for found in view.objects.values():
        node = objects[found.object_id]
        assert (node["x"], node["y"]) == stands(view, found)
        assert node["obs_count"] == found.obs_count
    edges = {frozenset((a, b)): v for a, b, v in graph.edges(data=True)}
    ways = {e: v for e, v in edges.items() if v["label"] == "ADJACENT_TO"}
    assert {e: v["shared_transitions"] for e, v in ways.items()} == {
        frozenset((view.place_id(a), view.place_id(b))): n for a, b, n in view.edges()
    }
    assert set(edges) - set(ways) == {
        frozenset((found.object_id, view.place_id(found.place)))
        for found in view.objects.values()
        if found.place is not None
    }


@given(maps())
def test_graphml_is_well_formed_whatever_a_class_is_called(view: MapView) -> None:
    names = {
        data.text
        for data in ElementTree.fromstring(graphml(view)).iter()
        if data.tag.endswith("data")
    }
    for found in view.objects.values():
        if found.class_name.isprintable():
            assert found.class_name.replace("\\", "\\\\") in names


def dot_strings(text: str) -> list[list[str]]:
    """The quoted strings of each line, with their escapes undone, by Graphviz' rules."""
    lines = []
    for line in text.splitlines():
        strings: list[str] = []
        characters = iter(line)
        for character in characters:
            if character == '"':
                strings.append("")
                while (inside := next(characters)) != '"':
                    strings[-1] += next(characters) if inside == "\\" else inside
        lines.append(strings)
    return lines


@given(maps())
def test_dot_has_a_line_for_each_node_and_edge(view: MapView) -> None:
    lines = dot_strings(dot(view))[3:-1]
    nodes = len(view.places) + len(view.objects)
    assert [line[0] for line in lines[:nodes]] == [
        *(place.place_id for place in view.places.values()),
        *(found.object_id for found in view.objects.values()),
    ]
    for line, found in zip(lines[len(view.places) : nodes], view.objects.values(), strict=True):
        if found.class_name.isprintable():
            assert line[1] == found.class_name
    for line, place in zip(lines[: len(view.places)], view.places.values(), strict=True):
        x, y = map(float, line[2].removesuffix("!").split(","))
        assert (x, y) == pytest.approx((place.centroid_x, place.centroid_y), abs=0.001)
    located = sum(found.place is not None for found in view.objects.values())
    assert len(lines) - nodes == located + len(view.edges())


@given(maps())
def test_tables_read_back_are_the_map(view: MapView) -> None:
    read = {
        name: list(csv.DictReader(io.StringIO(text, newline="")))
        for name, text in tables(view, raw=True).items()
    }
    assert [(row["place_id"], float(row["centroid_x"])) for row in read["places.csv"]] == [
        (place.place_id, place.centroid_x) for place in view.places.values()
    ]
    located = [row["place_id"] for row in read["objects.csv"]]
    assert [int(row["object_count"]) for row in read["places.csv"]] == [
        located.count(place.place_id) for place in view.places.values()
    ]
    assert [(row["object_id"], row["class_name"]) for row in read["objects.csv"]] == [
        (found.object_id, found.class_name) for found in view.objects.values()
    ]
    assert [
        (int(row["offset"]), row["run_id"], float(row["map_x"]), row["place_id"] or None)
        for row in read["keyframes.csv"]
    ] == [
        (k.offset, k.run_id, k.pose.x_m if k.pose else None, view.place_id(k.place))
        for k in view.keyframes
    ]
    assert len(read["adjacency.csv"]) == len(view.edges())


def _naive_corners(points: list[tuple[int, int]]) -> set[tuple[int, int]]:
    """Ends of every segment that has all points on its left or on itself: corners of the hull."""

    def side(a: tuple[int, int], b: tuple[int, int], c: tuple[int, int]) -> int:
        return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])

    def edge(a: tuple[int, int], b: tuple[int, int]) -> bool:
        length = math.dist(a, b)
        return all(
            side(a, b, c) > 0
            or (side(a, b, c) == 0 and max(math.dist(a, c), math.dist(b, c)) <= length)
            for c in points
        )

    return {end for a in points for b in points if a != b and edge(a, b) for end in (a, b)}


@given(maps())
def test_geojson_outlines_are_convex_hulls(view: MapView) -> None:
    features = json.loads(geojson(view))["features"]
    by_kind: dict[str, list[Any]] = {"place": [], "object": [], "adjacency": [], "run": []}
    for feature in features:
        by_kind[feature["properties"]["kind"]].append(feature)
    for place, feature in zip(view.places.values(), by_kind["place"], strict=True):
        poses = [view.keyframes[k].pose for k in place.members]
        points = sorted({(pose.x_um, pose.y_um) for pose in poses if pose is not None})
        corners = _naive_corners(points)
        if len(corners) < 3:  # one point, or all on a line
            assert feature["geometry"]["type"] == "Point"
            continue
        (ring,) = feature["geometry"]["coordinates"]
        assert ring[0] == ring[-1]
        assert len(ring) == len(corners) + 1
        assert {tuple(corner) for corner in ring} == {(x / 1e6, y / 1e6) for x, y in corners}
        area = sum(a[0] * b[1] - b[0] * a[1] for a, b in pairwise(ring))
        assert area > 0, "an outer ring is counter-clockwise"
    for found, feature in zip(view.objects.values(), by_kind["object"], strict=True):
        assert tuple(feature["geometry"]["coordinates"]) == stands(view, found)
        assert feature["properties"]["class_name"] == found.class_name
    assert len(by_kind["adjacency"]) == len(view.edges())


@given(maps())
def test_waypoints_are_centroids_or_where_the_robot_was(view: MapView) -> None:
    waypoints = yaml.safe_load(nav2_waypoints(view))["waypoints"]
    assert list(waypoints) == [place.place_id for place in view.places.values()]
    for place, waypoint in zip(view.places.values(), waypoints.values(), strict=True):
        x, y, z = waypoint["pose"]
        w, *axis = waypoint["orientation"]
        centre = (place.centroid_x, place.centroid_y)
        poses = [view.keyframes[k].pose for k in place.members]
        known = [pose for pose in poses if pose is not None]
        least = min(math.dist((pose.x_m, pose.y_m), centre) for pose in known)
        if least <= NEAR_M:
            assert (x, y) == centre
        else:
            assert (x, y) in {(pose.x_m, pose.y_m) for pose in known}
            assert math.dist((x, y), centre) == pytest.approx(least)
        assert z == axis[0] == axis[1] == 0
        yaw = 2 * math.atan2(axis[2], w)
        assert any(
            math.dist((pose.x_m, pose.y_m), centre) == pytest.approx(least)
            and math.cos(pose.yaw_rad - yaw) > 1 - 1e-9
            for pose in known
        )


def ecef(latitude: float, longitude: float) -> np.ndarray:
    """Earth-centred coordinates, metres, of a point on the WGS 84 ellipsoid; degrees."""
    a, f = 6378137.0, 1 / 298.257223563
    e2 = f * (2 - f)
    phi, lam = math.radians(latitude), math.radians(longitude)
    n = a / math.sqrt(1 - e2 * math.sin(phi) ** 2)
    return np.array(
        [
            n * math.cos(phi) * math.cos(lam),
            n * math.cos(phi) * math.sin(lam),
            n * (1 - e2) * math.sin(phi),
        ]
    )


@given(
    st.floats(-75, 75),
    st.floats(-179, 179),
    st.floats(-180, 180),
    st.floats(0, 6.3),
    st.floats(0, 500),
)
def test_an_origin_keeps_distances_and_directions(
    latitude: float, longitude: float, yaw: float, direction: float, distance: float
) -> None:
    origin = Origin(latitude, longitude, yaw)
    there = origin.geographic(distance * math.cos(direction), distance * math.sin(direction))
    phi, lam = math.radians(latitude), math.radians(longitude)
    east = np.array([-math.sin(lam), math.cos(lam), 0])
    north = np.array(
        [-math.sin(phi) * math.cos(lam), -math.sin(phi) * math.sin(lam), math.cos(phi)]
    )
    moved = ecef(there[1], there[0]) - ecef(latitude, longitude)
    turned = direction + math.radians(yaw)
    expected = distance * math.cos(turned), distance * math.sin(turned)
    assert (float(moved @ east), float(moved @ north)) == pytest.approx(expected, abs=0.1)


def test_a_missing_origin_is_said_in_the_file(tmp_path: Path) -> None:
    view = fold([envelope(1)]).view
    assert json.loads(geojson(view))["coordinates"] == "metres of the map frame"
    assert "coordinates" not in json.loads(geojson(view, Origin(52.5, 13.4)))


ODD = st.text(st.sampled_from("\\xu0123abfe\"'=\ufffe\uffff\u202e<&"), min_size=1, max_size=12)


def undone(text: str) -> str:
    """A text without the escapes of an export."""
    return re.sub(
        r"\\(\\|x(..)|u(....)|U(.{8}))",
        lambda found: chr(int(code, 16)) if (code := found[2] or found[3] or found[4]) else "\\",
        text,
    )


@given(st.lists(ODD, min_size=2, max_size=5, unique=True))
@example(["a\ufffe", "a\\ufffe", "a\\\ufffe", "a\\\\ufffe"])
@example(["\u202e", "\\u202e"])
def test_ids_that_differ_are_nodes_that_differ(names: list[str]) -> None:
    """Each run has a Place of its own; its id, read back, is that of the map."""
    import networkx

    documents = [
        envelope(k, 100.0 * number, 0.1 * k, run_id=run)
        for number, run in enumerate(names)
        for k in range(3)
    ]
    view = fold(documents).view
    expected = [place.place_id for place in view.places.values()]
    assert len(expected) == len(names)
    graph = networkx.parse_graphml(graphml(view))
    assert [undone(node) for node in graph] == expected
    assert len(set(dict(graph.nodes(data="label")).values())) == len(names)
    nodes = [line[0] for line in dot_strings(dot(view))[3:-1] if len(line) > 2]
    assert [undone(node) for node in nodes[: len(names)]] == expected


@given(st.lists(st.text(st.sampled_from("=+-@'a1,\""), min_size=1), min_size=1, max_size=4))
def test_no_text_in_a_table_is_a_formula_and_numbers_stay(classes: list[str]) -> None:
    documents = [
        envelope(k, -1.5, 0.0, detections=[detection(name, [1.0])])
        for k, name in enumerate(dict.fromkeys(classes))
    ]
    view = fold(documents).view
    rows = list(csv.DictReader(io.StringIO(tables(view)["objects.csv"], newline="")))
    assert {row["mean_x"] for row in rows} <= {"-1.5"}
    for row, found in zip(rows, view.objects.values(), strict=True):
        assert row["class_name"][0] not in "=+-@\t\r\n"
        assert row["class_name"].removeprefix("'") == (
            found.class_name if row["class_name"][0] == "'" else row["class_name"]
        )
        assert (row["class_name"] == found.class_name) == (found.class_name[0] in 'a1,"')


def test_neato_may_not_move_places() -> None:
    assert "overlap=true" in dot(fold([envelope(1)]).view).splitlines()[1]
