"""Regions of places, as state, GeoJSON and viewers have them."""

import json
import math
from dataclasses import replace
from itertools import pairwise

import pytest

from eventsrc.envelope.occupancy_map import OccupancyMap
from projections.adapters.export.graphs import graphml
from projections.adapters.export.lists import geojson
from projections.adapters.scene import places_of
from projections.fold.settings import Settings
from projections.map.place_regions import place_regions
from projections.map.state_output import state_document
from projections.map.view import MapView
from tests.support.envelopes import envelope
from tests.support.folds import Folded
from tests.support.maps import drawn_map

ROWS = ["#" * 21, *["#" + "." * 9 + "#" + "." * 9 + "#"] * 7, "#" * 21]
"""Two rooms of 4.5 by 3.5 m, in cells of 0.5 m, closed off from each other."""
ROOM_M2 = 63 * 0.25
SIDES = ((2.0, 2.0), (8.0, 2.0))


def two_rooms(
    given: list[OccupancyMap], spots: list[tuple[float, float]], places: str = "rooms"
) -> MapView:
    """The map of a robot at some spots of each map's floor."""
    folded = Folded.start(Settings.model_validate({"places": places}))
    for each in given:
        offset = folded.map.next_offset
        folded.view.apply_event(offset, folded.map.use_map(offset, each))
    for number, each in enumerate(given):
        floor = {} if each.floor is None else {"floor": each.floor}
        first = number * len(spots)
        folded.extend(envelope(first + k, x, y, **floor) for k, (x, y) in enumerate(spots))
    return folded.view


def test_a_room_is_a_polygon_of_its_free_cells() -> None:
    view = two_rooms([drawn_map("\n".join(ROWS), 0.5)], list(SIDES))
    left, right = place_regions(view).values()
    assert left.geometry() == {
        "type": "Polygon",
        "coordinates": [[[0.5, 0.5], [5.0, 0.5], [5.0, 4.0], [0.5, 4.0], [0.5, 0.5]]],
    }
    assert left.area_m2 == right.area_m2 == ROOM_M2
    rows = state_document(view, None)["places"]
    assert [row["region"] for row in rows] == [left.geometry(), right.geometry()]
    assert [row["area_m2"] for row in rows] == [ROOM_M2] * 2


def test_a_turned_map_places_the_corners() -> None:
    turned = drawn_map("\n".join(ROWS), 0.5, (10.0, 20.0, math.pi / 2))
    view = two_rooms([turned], [(8.0, 22.0), (8.0, 28.0)])
    left, _ = place_regions(view).values()
    ((ring,),) = left.polygons
    assert left.area_m2 == ROOM_M2
    assert sorted(set(ring)) == [(6.0, 20.5), (6.0, 25.0), (9.5, 20.5), (9.5, 25.0)]
    area = sum(ax * by - bx * ay for (ax, ay), (bx, by) in pairwise(ring)) / 2
    assert area == pytest.approx(ROOM_M2), "the outer ring is counter-clockwise"


def test_an_unknown_patch_is_a_hole_and_a_pillar_too() -> None:
    rows = [*ROWS]
    rows[4] = "#" + "...?.###." + "#" + rows[4][11:]
    view = two_rooms([drawn_map("\n".join(rows), 0.5)], [SIDES[0]])
    (region,) = place_regions(view).values()
    ((outer, *holes),) = region.polygons
    assert len(outer) == 5
    assert sorted(len(hole) for hole in holes) == [5, 5]
    assert region.area_m2 == ROOM_M2 - 4 * 0.25


def test_each_floor_has_regions_by_its_own_map() -> None:
    ground = replace(drawn_map("\n".join(ROWS), 0.5), floor="0")
    hall = replace(drawn_map("\n".join(["#" * 21, *["#" + "." * 19 + "#"] * 7, "#" * 21]), 0.5))
    view = two_rooms([ground, replace(hall, floor="1")], [SIDES[0]])
    below, above = place_regions(view).values()
    assert (below.area_m2, above.area_m2) == (ROOM_M2, 7 * 19 * 0.25)


@pytest.mark.parametrize("places", ["page", "rooms"])
def test_places_without_walls_have_no_region(places: str) -> None:
    given = [drawn_map("\n".join(ROWS), 0.5)] if places == "page" else []
    view = two_rooms(given, [SIDES[0]] * 3, places)
    assert place_regions(view) == {}
    assert all("region" not in row for row in state_document(view, None)["places"])


def test_geojson_graphml_and_viewers_have_the_region_instead_of_a_hull() -> None:
    import networkx

    view = two_rooms([drawn_map("\n".join(ROWS), 0.5)], list(SIDES))
    features = [f for f in json.loads(geojson(view))["features"] if "area_m2" in f["properties"]]
    regions = list(place_regions(view).values())
    assert [f["geometry"] for f in features] == [region.geometry() for region in regions]
    assert [shown.outlines for shown in places_of(view)] == [r.polygons[0] for r in regions]
    nodes = networkx.parse_graphml(graphml(view)).nodes.values()
    assert [json.loads(node["region"]) for node in nodes] == [r.geometry() for r in regions]
    assert [node["area_m2"] for node in nodes] == [region.area_m2 for region in regions]
