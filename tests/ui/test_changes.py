"""Points 7 to 9: corrections, a log that grows, and what can be taken away."""

import json
import re
import shlex
import shutil
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from eventsrc.log import LogReader
from tests.support.commands import Commands
from tests.support.logs import append_raw
from tests.support.ui_page import UiServer, showing
from tests.ui.browser import other_pixels, pixels, point_over, whole
from tests.ui.conftest import SAMPLE, WIDE, Visit
from tests.ui.test_moments import moment


@pytest.fixture
def edited(mapfold: Commands, tmp_path: Path) -> Iterator[tuple[Path, UiServer]]:
    log = Path(shutil.copytree(SAMPLE, tmp_path / "log"))
    with showing(mapfold, log, *WIDE, "--allow-edits") as server:
        yield log, server


def record(page: Page, reason: str) -> None:
    page.get_by_role("button", name="Preview").click()
    expect(page.locator(".preview")).to_contain_text("Would change")
    page.get_by_label("Reason").fill(reason)
    page.get_by_role("button", name="Record it").click()
    expect(page.get_by_role("status").filter(has_text="Recorded at offset")).to_be_visible()


def test_a_place_is_renamed_from_the_context_menu_and_the_name_undone(
    edited: tuple[Path, UiServer], visit: Visit, mapfold: Commands
) -> None:
    log, server = edited
    page = visit(server, "#panel=why")
    page.mouse.click(*point_over(page, "sim-7-a_p6"), button="right")
    page.get_by_role("menuitem", name="Rename this place").click()
    expect(page.get_by_role("textbox", name="Name")).to_be_focused()
    at = moment(page)
    page.keyboard.type("<b>guests</b> m")  # letters of shortcuts
    assert moment(page) == at
    page.keyboard.press("Backspace")
    page.keyboard.press("Backspace")
    page.get_by_role("button", name="Record it").click()
    corrections = page.locator(".corrections > li")
    expect(corrections).to_have_count(1)
    expect(corrections).to_contain_text("<b>guests</b>")
    given = mapfold("edits", log, "--json").json
    assert [(each["kind"], each["reason"]) for each in given] == [("name-place", "")]
    page.get_by_role("tab", name="Why").click()
    page.keyboard.press("End")
    page.keyboard.press("Escape")
    expect(page.locator("table.rooms")).to_contain_text("<b>guests</b>")
    page.get_by_role("tab", name="Correct").click()
    corrections.get_by_role("button", name="Undo").click()
    record(page, "not asked")
    expect(corrections).to_have_count(2)
    expect(corrections.first).to_contain_text("undone by")


def test_what_was_recorded_is_undone_beside_it(
    edited: tuple[Path, UiServer], visit: Visit, pictures: Path
) -> None:
    _, server = edited
    page = visit(server, "#panel=correct")
    page.get_by_label("Place", exact=True).fill("p6")
    page.get_by_role("textbox", name="Name").fill("guests")
    page.get_by_role("button", name="Record it").click()
    expect(page.locator(".corrections > li")).to_have_count(1)
    page.screenshot(path=pictures / "undo.png")
    page.get_by_role("button", name="Undo it").click()
    expect(page.locator(".corrections > li")).to_have_count(2)
    expect(page.locator(".corrections > li").first).to_contain_text("undone by")


def drag(page: Page, start: tuple[float, float], end: tuple[float, float]) -> None:
    page.mouse.move(*start)
    page.mouse.down()
    page.mouse.move(*end, steps=5)


def test_places_are_joined_and_cut_by_dragging_with_preview_and_undo(
    edited: tuple[Path, UiServer], visit: Visit, pictures: Path
) -> None:
    page = visit(edited[1], "#panel=correct")
    one, other = point_over(page, "sim-7-a_p5"), point_over(page, "sim-7-a_p6")
    plain = pixels(page)
    drag(page, other, one)
    page.mouse.up()
    other_pixels(page, plain)  # the view moved
    page.get_by_role("button", name="Show the whole map").click()
    page.get_by_label("by dragging on the map").check()
    one, other = point_over(page, "sim-7-a_p5"), point_over(page, "sim-7-a_p6")
    drag(page, one, other)
    expect(page.locator(".tip")).to_have_text("Join \u2068p5\u2069 with \u2068p6\u2069")
    page.screenshot(path=pictures / "drag.png")
    page.mouse.up()
    expect(page.locator(".preview b")).to_contain_text("Would change")
    expect(page.locator("#correction-kind")).to_have_value("join")
    page.get_by_label("Reason").fill("one room")
    page.get_by_role("button", name="Record it").click()
    corrections = page.locator(".corrections > li")
    expect(corrections).to_have_count(1)
    expect(page.locator(".facts")).to_contain_text("5 places")
    page.get_by_role("button", name="Undo it").click()
    expect(corrections.first).to_contain_text("undone by")
    expect(page.locator(".facts")).to_contain_text("6 places")

    start = point_over(page, "sim-7-a_p0")
    page.mouse.move(*start)
    drag(page, start, (start[0] + 60, start[1]))
    expect(page.locator(".tip")).to_contain_text("Cut")
    page.mouse.up()
    expect(page.locator("#correction-kind")).to_have_value("keep-apart")
    expect(page.locator(".preview b").or_(page.locator(".correction .error"))).to_be_visible()
    expect(page.get_by_label("Place", exact=True)).to_have_value(re.compile(r"sim-7-a:\d+"))
    page.mouse.click(*start)
    expect(page.get_by_role("tab", name="Why")).to_have_attribute("aria-selected", "true")


def test_an_object_is_dragged_onto_another_whose_class_its_own_becomes(
    edited: tuple[Path, UiServer], visit: Visit
) -> None:
    page = visit(edited[1], "#panel=correct")
    page.get_by_label("by dragging on the map").check()
    start, end = point_over(page, "sink"), point_over(page, "oven")
    drag(page, start, end)
    expect(page.locator(".tip")).to_contain_text("oven")
    page.mouse.up()
    expect(page.get_by_label("Class=new name")).to_have_value("sink=oven")
    expect(page.locator(".preview b")).to_contain_text("Would change")
    page.get_by_role("button", name="Record it").click()
    expect(page.locator(".corrections > li")).to_have_count(1)


def test_a_merge_is_undone_with_a_preview_of_what_changes(
    edited: tuple[Path, UiServer], visit: Visit, mapfold: Commands
) -> None:
    log, server = edited
    said = mapfold("edit", log, "undo-merge", "348", "--dry-run", *WIDE).out
    page = visit(server, "#panel=correct")
    page.locator("#correction-kind").select_option("undo-merge")
    page.get_by_label("Offset of the merge").fill("348")
    page.get_by_role("button", name="Preview").click()
    expect(page.locator(".preview b")).to_have_text(
        "Would change 2 places, 18 objects, 102 keyframes"
    )
    assert "102 changed place" in said
    expect(page.locator(".preview .lines")).to_contain_text("102 changed place")
    assert len(mapfold("edits", log, "--json").json) == 0
    expect(page.get_by_role("button", name="Record it")).to_be_disabled()
    page.get_by_label("Reason").fill("a door")
    page.get_by_role("button", name="Record it").click()
    expect(page.locator(".corrections > li")).to_have_count(1)
    page.keyboard.press("Escape")
    page.locator("body").press("End")
    expect(page.locator(".facts")).to_contain_text("7 places")
    page.get_by_label("Offset of the merge").or_(page.get_by_label("Place")).first.wait_for()
    page.locator("#correction-kind").select_option("undo-merge")
    page.get_by_label("Offset of the merge").fill("3")
    page.get_by_role("button", name="Preview").click()
    expect(page.locator(".correction .error")).to_contain_text("merge")


def test_without_leave_the_page_only_looks(sample: UiServer, visit: Visit) -> None:
    page = visit(sample, "#panel=correct")
    expect(page.locator(".note")).to_contain_text("--allow-edits")
    expect(page.locator("form.correction")).to_have_count(0)
    page.locator("canvas.map").click(button="right", position={"x": 300, "y": 240})
    expect(page.get_by_role("menuitem", name="Rename")).to_have_count(0)


def test_a_growing_log_is_followed_and_a_moment_kept(
    mapfold: Commands, visit: Visit, tmp_path: Path
) -> None:
    with LogReader(SAMPLE) as reader:
        payloads = [bytes(event.payload) for event in reader.read()]
    log = tmp_path / "log"
    for payload in payloads[:100]:
        append_raw(log, payload)
    with showing(mapfold, log, *WIDE) as server:
        page = visit(server)
        expect(page.locator(".facts")).to_contain_text("100 keyframes")
        live = page.get_by_role("button", name="Live")
        expect(live).to_have_count(0)  # it is as if imported
        for payload in payloads[100:180]:
            append_raw(log, payload)
        expect(page.locator(".facts")).to_contain_text("180 keyframes")
        expect(live).to_have_attribute("aria-pressed", "true")
        assert moment(page) == 180
        page.get_by_role("button", name="Live").click()
        for payload in payloads[180:200]:
            append_raw(log, payload)
        expect(page.locator(".moment")).to_contain_text("of 200 events")
        expect(page.locator(".facts")).to_contain_text("180 keyframes")
        page.keyboard.press("l")
        expect(page.locator(".facts")).to_contain_text("200 keyframes")


def test_the_view_is_taken_away_as_picture_state_and_command(
    sample: UiServer, visit: Visit, mapfold: Commands, tmp_path: Path
) -> None:
    page = visit(sample, "#at=349", permissions=["clipboard-read", "clipboard-write"])

    def taken(item: str) -> bytes:
        page.get_by_role("button", name="Take away").click()
        with page.expect_download() as waiting:
            page.get_by_role("menuitem", name=item).click()
        path = tmp_path / waiting.value.suggested_filename
        waiting.value.save_as(path)
        assert path.name.startswith("sample-349.")
        return path.read_bytes()

    assert taken("Picture as PNG").startswith(b"\x89PNG\r\n\x1a\n")
    svg = ET.fromstring(taken("Picture as SVG"))
    texts = {
        "".join(text.itertext()).strip("\u2068\u2069")
        for text in svg.iter()
        if text.tag.endswith("}text")
    }
    assert {"p0", "p6", "134"} <= texts
    saved = json.loads(taken("State as JSON"))
    wanted = mapfold("state", SAMPLE, *WIDE, "--at", "349", "--json").json
    places = {p["place_id"]: p["keyframe_count"] for p in wanted["places"]}
    assert {p["place_id"]: p["keyframes"] for p in saved["places"]} == places
    assert len(saved["objects"]) == wanted["counts"]["objects"]
    page.get_by_role("button", name="Take away").click()
    whole(page)  # the command comes with it
    page.get_by_role("menuitem", name="Copy as command").click()
    clipboard = "navigator.clipboard.readText()"
    page.wait_for_function(f"async () => (await {clipboard}).startsWith('mapfold ')")
    command = page.evaluate(f"() => {clipboard}")
    program, *words = shlex.split(command)
    assert program == "mapfold"
    assert wanted["digest"] in mapfold(*words).out
