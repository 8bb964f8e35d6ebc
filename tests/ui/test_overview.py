"""The opening panel: rooms, objects, what changed and what is odd are what the commands say."""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page, expect

from eventsrc.adapters.detector.vision import encode_jpeg
from eventsrc.log import NEVER, LogWriter
from tests.support.commands import Commands
from tests.support.logs import write_log
from tests.support.models import add_crop
from tests.support.ui_page import UiServer, showing
from tests.ui.browser import pixels
from tests.ui.conftest import Visit
from tests.ui.test_moments import go
from tests.unit.test_moved_things import ROOM, run
from tests.unit.test_what_changed import LATER

EVIDENCE = ("--set", "fusion=evidence", "--set", "places=rooms")


@pytest.fixture(scope="module")
def moved(mapfold: Commands, tmp_path_factory: pytest.TempPathFactory) -> Iterator[UiServer]:
    """Two runs; before the second one the chair and the plant were carried away, a bed came."""
    log = write_log(tmp_path_factory.mktemp("moved") / "log", [*run("a", ROOM), *run("b", LATER)])
    with showing(mapfold, log, *EVIDENCE) as server:
        yield server


def column(page: Page, table: str, number: int) -> list[str]:
    cells = page.locator(f"table.{table} tbody tr > :nth-child({number})").all_inner_texts()
    return [each.strip("\u2068\u2069") for each in cells]


def test_rooms_and_objects_are_those_of_the_commands(
    rooms: UiServer, visit: Visit, mapfold: Commands, pictures: Path
) -> None:
    page = visit(rooms)
    log = rooms.api("log")["path"]
    listed = page.locator("table.rooms tbody tr")
    expect(listed).to_have_count(8)
    for row in listed.all():
        short = re.findall(r"\bp\d+\b", row.inner_text())[-1]
        known = mapfold("room", log, short, "--json").json
        area, objects, last = row.locator("td").all_inner_texts()
        assert float(area.removesuffix(" m²")) == pytest.approx(known["area_m2"], abs=0.5)
        assert int(objects) == len(known["objects"])
        assert last == known["last_visited"]["iso"][11:16]
        assert known["type"] is None or known["type"] in row.inner_text()
    found = mapfold("find", log, "--top", "200", "--json").json
    expect(page.locator("#panel h2").nth(1)).to_have_text(
        f"{found['count']} objects + {found['unconfirmed']} seen once"
    )
    assert column(page, "objects", 1) == [each["class_name"] for each in found["answers"][:12]]
    assert column(page, "objects", 3) == [str(each["obs_count"]) for each in found["answers"][:12]]
    page.screenshot(path=pictures / "overview.png")
    listed.first.get_by_role("button").click()
    expect(page.locator(".thing .kind")).to_have_text("place")


def test_while_it_loads_the_panel_says_so_and_never_that_there_are_no_rooms(
    rooms: UiServer, visit: Visit
) -> None:
    page = visit(rooms, wait=False)
    asked: list[str] = []
    page.on("request", lambda r: asked.append(r.url) if "/api/overview" in r.url else None)
    page.route("**/api/overview*", lambda route: None)  # unanswered for now
    page.reload()
    panel = page.locator("#panel")
    expect(panel).to_have_text("Loading rooms and objects …")
    page.unroute("**/api/overview*")
    page.reload()
    expect(panel.locator("h2").first).to_have_text("8 rooms")
    through = rooms.api("log")["through"]
    assert asked
    assert all(f"at={through}" in url for url in asked)


def test_objects_are_sorted_and_filtered(rooms: UiServer, visit: Visit) -> None:
    page = visit(rooms)
    page.get_by_role("button", name="all 49").click()
    expect(page.locator("table.objects tbody tr")).to_have_count(49)
    for name, number in (("class", 1), ("seen", 3)):
        orders = []
        for _ in range(2):
            page.locator("table.objects thead").get_by_role("button", name=name).first.click()
            shown = column(page, "objects", number)
            orders.append([int(each) for each in shown] if number == 3 else shown)
        assert orders[0] != orders[1]
        ascending = sorted(orders[0])
        assert sorted(orders) == sorted([ascending, ascending[::-1]])
    page.get_by_label("Only objects that are").fill("chairs")
    wanted = rooms.api("find", what="chairs", top=200)
    expect(page.locator("table.objects tbody tr")).to_have_count(wanted["count"])
    kitchen = next(each for each in rooms.api("overview")["rooms"] if each["type"] == "kitchen")
    page.get_by_label("Only objects that are").fill("")
    page.get_by_label("Only objects in").select_option(kitchen["place_id"])
    expect(page.locator("table.objects tbody tr")).to_have_count(kitchen["objects"])
    page.get_by_role("checkbox", name="seen once", exact=True).check()
    every = kitchen["objects"] + kitchen["unconfirmed"]
    expect(page.locator("table.objects tbody tr")).to_have_count(min(every, 12))
    page.get_by_label("Only objects that are").fill("unicorn")
    expect(page.locator("#panel .error")).to_contain_text("no class like 'unicorn'")


def test_what_changed_since_the_run_before_is_listed(moved: UiServer, visit: Visit) -> None:
    page = visit(moved)
    shown = page.locator(".changed li")
    expect(shown).to_have_count(3)
    expect(page.locator(".changed h2")).to_have_text("Since b began")
    for row, change in zip(shown.all(), moved.api("changes")["changes"], strict=True):
        expect(row).to_contain_text(f"{change['class_name']} {change['kind']}")
        expect(row).to_have_attribute("title", change["sentence"])
    go(page, 60)  # within the first run
    expect(page.locator(".changed")).to_have_count(0)


def test_runs_are_compared_and_what_changed_is_walked_through(
    moved: UiServer, visit: Visit, pictures: Path
) -> None:
    page = visit(moved)
    page.get_by_role("tab", name="Compare").click()
    start = page.get_by_label("From the start of")
    assert start.locator("option:checked").inner_text() == "b"
    changes = moved.api("changes")["changes"]
    shown = page.locator(".walked li")
    expect(shown).to_have_count(len(changes))
    expect(page.locator(".summary").first).to_contain_text("1 moved, 1 missing, 1 new")
    for _ in range(len(changes) + 1):
        page.keyboard.press("ArrowDown")
    expect(shown.nth(2)).to_have_attribute("aria-current", "true")
    page.keyboard.press("ArrowUp")
    expect(shown.nth(1)).to_have_attribute("aria-current", "true")
    page.get_by_label("before and after side by side").check()
    before = page.get_by_role("img", name=f"Map after {moved.api('changes')['since']} events")
    after = page.get_by_role("img", name=f"Map after {moved.api('log')['through']} events")
    boxes = before.bounding_box(), after.bounding_box()
    assert boxes[0] is not None
    assert boxes[1] is not None
    assert boxes[0]["x"] + boxes[0]["width"] <= boxes[1]["x"]
    expect(page).to_have_url(re.compile("beside=1"))
    page.reload()
    expect(before).to_be_visible()
    assert pixels(page, "other") != pixels(page, "main")
    page.screenshot(path=pictures / "beside.png")
    start.select_option(label="a")
    expect(shown).to_have_count(0)


def test_what_is_odd_names_the_command_that_helps(moved: UiServer, visit: Visit) -> None:
    page = visit(moved)
    page.locator(".odd summary").click()
    odd = moved.api("overview")["odd"]
    said = {each["says"].split()[0] for each in odd}
    assert {"No", "Nothing"} <= said
    rows = page.locator(".odd li")
    for row, each in zip(rows.all(), odd, strict=True):
        expect(row).to_contain_text(each["says"])
        expect(row.locator("code")).to_have_text(each["command"])


def test_the_table_has_the_best_picture_of_each_object(
    mapfold: Commands, visit: Visit, tmp_path: Path
) -> None:
    log = write_log(tmp_path / "log", run("a", ROOM))
    picture = encode_jpeg(np.full((30, 20, 3), 90, np.uint8))
    with LogWriter(log, fsync=NEVER) as writer:
        for number, document in enumerate(run("a", ROOM)):
            for index, _ in enumerate(document["detections"]):
                add_crop(writer, f"a_kf{number}_d{index}", picture)
    with showing(mapfold, log, *EVIDENCE) as server:
        assert server.api("overview")["crops"]
        page = visit(server)
        expect(page.locator("table.objects img").first).to_be_visible()
