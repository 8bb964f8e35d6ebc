"""Walls, floors and kinds of rooms: what the map and the panels say is what the log has."""

import itertools
import json
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from playwright.sync_api import Page, expect

from eventsrc.adapters.sim import simulate_run
from eventsrc.adapters.sim.house import occupancy_map
from eventsrc.envelope.occupancy_map import MIN_WALL, OCCUPIED, OccupancyMap
from eventsrc.envelope.system_events import MAP_KEY
from eventsrc.log import NEVER, LogWriter
from tests.property.test_floors import drive
from tests.support.commands import Commands
from tests.support.envelopes import payload
from tests.support.logs import KEY, write_log
from tests.support.ui_page import UiServer, showing
from tests.ui.browser import answered, other_pixels, pixels, whole
from tests.ui.conftest import SAMPLE, WIDE, Visit
from tests.ui.test_moments import go, moment

ROOMS = ("--set", "places=rooms")
RUN_A = 445
"""Keyframes of the simulator's first run."""
Building = tuple[Path, UiServer]


@pytest.fixture(scope="module")
def building(mapfold: Commands, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Building]:
    """Two floors with the same rooms: the ground floor's walls come first, half of the upper
    floor's in the middle of its drive."""
    log = tmp_path_factory.mktemp("building") / "log"
    lower, upper = simulate_run(run="a"), simulate_run(run="b")
    walls = occupancy_map(lower.house)
    half = walls.cells.copy()
    half[: len(half) // 2] = 0
    with LogWriter(log, fsync=NEVER) as writer:
        writer.append(MAP_KEY, replace(walls, floor="ground").encode(), logged_ns=1)
        for floor, run in (("ground", lower), ("1", upper)):
            for number, envelope in enumerate(run.envelopes):
                if floor == "1" and number == 100:
                    given = replace(walls, floor="1", cells=half).encode()
                    writer.append(MAP_KEY, given, logged_ns=1)
                document = payload(envelope | {"floor": floor})
                writer.append(KEY, document, logged_ns=int(envelope["timestamp"] * 1e9))
    with showing(mapfold, log, *ROOMS) as server:
        yield log, server


def picture(page: Page) -> ET.Element:
    """The view as SVG, when the page has all that it asked for."""
    answered(page)
    page.get_by_role("button", name="Take away").click()
    with page.expect_download() as waiting:
        page.get_by_role("menuitem", name="Picture as SVG").click()
    return ET.fromstring(Path(waiting.value.path()).read_text())


def labels(svg: ET.Element) -> list[str]:
    texts = (text for text in svg.iter() if text.tag.endswith("}text"))
    return ["".join(text.itertext()).strip("\u2068\u2069") for text in texts]


def outlines(svg: ET.Element) -> list[NDArray[np.float64]]:
    """The closed outlines of the walls, in pixels."""
    drawn = [path for path in svg.iter() if path.get("fill-rule") == "evenodd"]
    return _rings(drawn[0]) if drawn else []


def regions(svg: ET.Element) -> list[list[NDArray[np.float64]]]:
    """The rings of each region, in pixels: what is filled below the walls."""
    paths = (path for path in svg.iter() if path.get("fill-rule") is not None)
    below = itertools.takewhile(lambda path: path.get("fill-rule") != "evenodd", paths)
    return [_rings(path) for path in below]


def _rings(path: ET.Element) -> list[NDArray[np.float64]]:
    parts = (path.get("d") or "").split("Z")
    return [np.array(re.findall(r"-?[\d.]+", part), float).reshape(-1, 2) for part in parts if part]


def filled(loops: list[NDArray[np.float64]], x: float, y: float) -> bool:
    """The even-odd rule, by counting the sides to the right of a point."""
    crossed = 0
    for loop in loops:
        for (ax, ay), (bx, by) in zip(loop, np.roll(loop, -1, axis=0), strict=True):
            if (ay > y) != (by > y) and x < ax + (y - ay) / (by - ay) * (bx - ax):
                crossed += 1
    return crossed % 2 == 1


def check_walls(page: Page, given: OccupancyMap) -> None:
    """What is filled in the picture are the occupied cells, in a view that is found from the
    outermost walls."""
    loops = outlines(picture(page))
    assert loops
    corners = np.vstack(loops)
    rows, columns = np.nonzero((given.cells >= MIN_WALL) & (given.cells <= OCCUPIED))
    left, below = columns.min(), rows.min()
    k = np.ptp(corners[:, 0]) / (np.ptp(columns) + 1)
    x0, y0 = corners[:, 0].min() - left * k, corners[:, 1].max() + below * k
    occupied = set(zip(rows.tolist(), columns.tolist(), strict=True))
    chosen = np.random.default_rng(7)
    cells = [*chosen.permutation(sorted(occupied))[:60].tolist()]
    cells += chosen.integers((0, 0), given.cells.shape, (60, 2)).tolist()
    for row, column in cells:
        inside = filled(loops, x0 + (column + 0.5) * k, y0 - (row + 0.5) * k)
        assert inside == ((row, column) in occupied), (row, column)


def test_walls_are_the_occupied_cells_at_any_zoom_and_can_be_hidden(
    building: Building, visit: Visit
) -> None:
    _, server = building
    given = occupancy_map(simulate_run(run="a").house)
    page = visit(server, "#at=300")
    for _ in range(3):
        check_walls(page, given)
        for _ in range(5):
            page.keyboard.press("+")
    page.keyboard.press("f")
    page.mouse.move(2, 2)
    with_walls = pixels(page)
    page.locator(".legend").get_by_text("wall", exact=True).click()
    page.mouse.move(2, 2)
    other_pixels(page, with_walls)
    assert outlines(picture(page)) == []


def test_the_map_fills_the_height_at_first_beside_its_counts(
    building: Building, visit: Visit
) -> None:
    page = visit(building[1], "#at=300")
    corners = np.vstack(outlines(picture(page)))
    canvas = page.locator("canvas.map").bounding_box()
    facts = page.locator(".facts").bounding_box()
    assert canvas is not None
    assert facts is not None
    share = np.ptp(corners[:, 1]) / canvas["height"]
    assert share == pytest.approx(0.95, abs=0.001)  # pictures round to hundredths of a pixel
    assert corners[:, 0].min() >= facts["x"] + facts["width"] - canvas["x"]


def test_walls_are_those_in_force_on_the_floor_at_the_moment(
    building: Building, visit: Visit
) -> None:
    _, server = building
    page = visit(server, "#at=0")
    assert outlines(picture(page)) == []
    go(page, 1)
    assert len(outlines(picture(page))) == 3
    go(page, RUN_A + 90)  # on the upper floor, before its map
    expect(page.get_by_label("floor")).to_contain_text("1\u2069, the robot’s")
    assert outlines(picture(page)) == []
    with page.expect_response(lambda got: got.url.endswith("/api/walls?number=1")):
        go(page, RUN_A + 120)
    whole = occupancy_map(simulate_run(run="b").house)
    half = whole.cells.copy()
    half[: len(half) // 2] = 0
    check_walls(page, replace(whole, cells=half))


def rings_of(place: dict[str, Any]) -> list[NDArray[np.float64]]:
    """The rings of a place's region, in metres."""
    parts = place["region"]["coordinates"]
    if place["region"]["type"] == "MultiPolygon":
        parts = [ring for part in parts for ring in part]
    return [np.array(ring[1:]) for ring in parts]


def test_the_region_of_a_place_is_its_free_floor(
    building: Building, visit: Visit, mapfold: Commands
) -> None:
    """In the picture, and under the pointer where neither a keyframe nor an object is near."""
    log, server = building
    page = visit(server, "#at=300&panel=none")
    for at in (RUN_A + 1, 300):
        go(page, at)
        whole(page)
        state = mapfold("state", log, *ROOMS, "--at", str(at), "--json").json
        rooms = {place["place_id"]: rings_of(place) for place in state["places"]}
        drawn = regions(picture(page))
        assert len(drawn) == len(rooms) > 3
        low, high = _extent(rooms.values())
        left, _ = _extent(drawn)[0]
        right, bottom = _extent(drawn)[1]
        k = (right - left) / (high - low)[0]
        at_zero = np.array([left - low[0] * k, bottom + low[1] * k])
        for rings in rooms.values():
            wanted = [at_zero + ring * (k, -k) for ring in rings]
            assert any(_same(wanted, each) for each in drawn)
    box = page.locator("canvas.map").bounding_box()
    assert box is not None
    near = [(k["map_x"], k["map_y"]) for k in state["keyframes"]]
    near += [(each["mean_x"], each["mean_y"]) for each in state["objects"]]
    spots = np.random.default_rng(7).uniform(low, high, (400, 2))
    spots = spots[(np.hypot(*(spots[:, None] - near).T) > 0.6).all(axis=0)][:40]
    pointed_at = set()
    around = [np.array(each) for each in ((0.06, 0.0), (-0.06, 0.0), (0.0, 0.06), (0.0, -0.06))]
    for spot in spots:
        (inside,) = [name for name, rings in rooms.items() if filled(rings, *spot)] or [None]
        if inside and not all(filled(rooms[inside], *(spot + step)) for step in around):
            continue  # a pixel or two from its border
        x, y = at_zero + spot * (k, -k)
        page.mouse.move(box["x"] + x, box["y"] + y)
        tip = page.locator(".tip div").nth(1)  # below the short name
        if inside is None:
            expect(tip).to_have_count(0)
        else:
            expect(tip).to_have_text(f"\u2068{inside}\u2069")
        pointed_at.add(inside)
    assert len(pointed_at) > 3


def _extent(rooms: Iterable[list[NDArray[np.float64]]]) -> tuple[NDArray[np.float64], ...]:
    """The lowest and the highest coordinates."""
    corners = np.vstack([ring for rings in rooms for ring in rings])
    return corners.min(axis=0), corners.max(axis=0)


def _same(wanted: list[NDArray[np.float64]], drawn: list[NDArray[np.float64]]) -> bool:
    return [len(ring) for ring in wanted] == [len(ring) for ring in drawn] and all(
        np.abs(a - b).max() < 0.05 for a, b in zip(wanted, drawn, strict=True)
    )


def places_of(mapfold: Commands, log: Path, at: int, *words: str) -> list[dict[str, Any]]:
    document = mapfold("state", log, *words, "--at", str(at), "--json").json
    return document["places"]  # type: ignore[no-any-return]


def labelled(page: Page, ids: set[str]) -> set[str]:
    """The ids whose end, without what ids have in common, is a label of the picture."""
    texts = set(labels(picture(page)))
    return {each for each in ids if any(each.endswith((f"-{t}", f"_{t}")) for t in texts)}


def test_one_floor_is_shown_and_another_can_be_chosen(
    building: Building, visit: Visit, mapfold: Commands
) -> None:
    log, server = building
    at = RUN_A + 200
    found = places_of(mapfold, log, at, *ROOMS)
    floors = {
        name: {p["place_id"] for p in found if p["floor"] == name} for name in ("ground", "1")
    }
    assert all(len(ids) > 2 for ids in floors.values())
    page = visit(server, f"#at={at}")
    choice = page.get_by_label("floor")
    expect(choice).to_contain_text("1\u2069, the robot’s")
    every = set().union(*floors.values())
    shown = labelled(page, every)
    assert shown <= floors["1"]
    assert len(shown) > 2
    upper = pixels(page)
    choice.select_option("0")
    shown = labelled(page, every)
    assert shown <= floors["ground"]
    assert len(shown) > 2
    page.mouse.move(2, 2)
    other_pixels(page, upper)
    expect(page.locator(".facts")).to_contain_text(f"{len(found)} places")  # of the whole building
    expect(page).to_have_url(re.compile("floor=ground"))
    again = visit(server, page.url.partition("/#")[2].join(["#", ""]))
    expect(again.get_by_label("floor")).to_have_value("0")
    chosen = min(floors["1"])
    again.get_by_label("Search places").fill(chosen)
    again.get_by_role("option").first.click()
    expect(again.locator(".facts-list")).to_contain_text("1\u2069, of 2 of the building")
    expect(again.get_by_label("floor")).to_have_value("1")


def test_a_log_of_one_floor_offers_none(sample: UiServer, visit: Visit) -> None:
    page = visit(sample)
    expect(page.locator(".facts")).to_contain_text("445 keyframes")
    expect(page.get_by_label("floor")).to_have_count(0)


def test_a_way_between_floors_is_on_both(mapfold: Commands, visit: Visit, tmp_path: Path) -> None:
    with showing(mapfold, write_log(tmp_path / "log", drive({"floor": 0}, {"floor": 1}))) as server:
        page = visit(server)
        for floor in ("0", "1"):
            page.get_by_label("floor").select_option(floor)
            said = labels(picture(page))
            assert {text for text in said if "×" in text} == {"1× between floors"}
            assert {"p0", "p1"} & set(said) == {f"p{floor}"}


def test_the_type_of_each_place_is_that_of_state(
    sample: UiServer, visit: Visit, mapfold: Commands
) -> None:
    """In the list, in the panel of a place with its probability, and in the label."""
    page = visit(sample, "#panel=why")
    types_seen = set()
    for at in (445, 150, 60):
        go(page, at)
        for place in places_of(mapfold, SAMPLE, at, *WIDE):
            name = page.locator("th", has_text=re.compile(rf"\b{_short(place)}$"))
            row = page.locator("table.rooms tbody tr").filter(has=name)
            kind, share = place.get("type"), place.get("type_probability")
            types_seen.add((kind is None, share is None))
            expect(row).to_contain_text(_short(place) if kind is None else kind)
            row.get_by_role("button").click()
            fact = page.locator(".facts-list div").filter(has_text=re.compile("^type"))
            if share is None:
                expect(fact).to_contain_text("unknown")
            elif kind is None:
                first = place["type_candidates"][0]
                share_of_first = f"{_percent(first['probability'])} %"
                expect(fact).to_contain_text(f"unsure: {first['type']} {share_of_first}")
            else:
                expect(fact).to_contain_text(f"{kind} {_percent(share)} %")
            page.keyboard.press("Escape")
        assert moment(page) == at
    assert {(False, False), (True, False)} <= types_seen
    go(page, 445)
    whole(page)
    expect(page.locator("table.rooms")).to_contain_text("kitchen")
    assert any(text.endswith("· kitchen") for text in labels(picture(page)))


def _short(place: dict[str, Any]) -> str:
    return str(place["place_id"]).removeprefix("sim-7-a_")


def _percent(share: float) -> int:
    return int(share * 100 + 0.5)


def test_the_state_taken_away_has_types_floors_and_regions(
    building: Building, visit: Visit, mapfold: Commands
) -> None:
    log, server = building
    page = visit(server, "#at=500")
    whole(page)
    page.get_by_role("button", name="Take away").click()
    with page.expect_download() as waiting:
        page.get_by_role("menuitem", name="State as JSON").click()
    saved = json.loads(Path(waiting.value.path()).read_text())
    names = ("place_id", "floor", "type", "type_probability", "region", "area_m2")
    kept = [{n: p[n] for n in names if n in p} for p in saved["places"]]
    wanted = places_of(mapfold, log, 500, *ROOMS)
    assert {"region" in place for place in wanted} == {True, False}  # above is no map yet
    assert kept == [{n: p[n] for n in names if n in p} for p in wanted]
