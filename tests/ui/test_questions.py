"""Points 3 to 6: why, compare, find, lost; the answers are those of the commands."""

import json
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlparse

import pytest
from playwright.sync_api import Page, expect

from tests.support.commands import Commands
from tests.support.ui_page import UiServer, showing
from tests.ui.browser import answered, other_pixels, pixels
from tests.ui.conftest import SAMPLE, WIDE, Visit
from tests.ui.test_moments import moment


def run_shown(page: Page, mapfold: Commands, *more: str) -> str:
    """What the command line that the panel shows prints."""
    line = page.locator("#panel .command code").first.inner_text()
    program, *words = shlex.split(line)
    assert program == "mapfold"
    return mapfold(*words, *more).out


def words(text: str) -> str:
    """Without the isolates around names, and spaces alike."""
    return " ".join(text.replace("\u2068", "").replace("\u2069", "").split())


def test_why_tells_the_story_of_a_place_step_by_step(
    sample: UiServer, visit: Visit, mapfold: Commands
) -> None:
    page = visit(sample, "#at=445&select=place:sim-7-a_p7&panel=why")
    steps = page.locator(".steps > li")
    expect(steps).to_have_count(7)
    told = words(run_shown(page, mapfold))
    for step in steps.all():
        offset = step.locator(".moment-link").inner_text()
        assert offset in told
        assert words(step.locator("p").first.inner_text()) in told
    steps.nth(0).locator(".moment-link").click()
    assert moment(page) == 255
    steps.nth(0).get_by_role("button", name="sim-7-a:249").first.click()
    expect(page.locator(".thing h2")).to_have_text("sim-7-a:249")


def test_why_draws_the_bridge_of_a_merge_before_and_after(
    sample: UiServer, visit: Visit, mapfold: Commands
) -> None:
    page = visit(sample, "#at=349&panel=why")
    plain = pixels(page)
    page.get_by_text("of places").click()
    page.get_by_role("button", name="p0 ← p7").click()
    expect(page.locator(".summary")).to_have_text("p0 absorbed p7")
    minis = page.locator(".mini canvas")
    expect(minis).to_have_count(2)
    answered(page)
    drawn = [mini.evaluate("canvas => canvas.toDataURL()") for mini in minis.all()]
    assert drawn[0] != drawn[1]
    expect(page.locator(".bridge figcaption")).to_contain_text("ε = 1 m")
    page.mouse.move(2, 2)
    other_pixels(page, plain)
    said = mapfold("merges", SAMPLE, *WIDE, "--show", "2").out
    assert words(page.locator(".lines").inner_text()) == words(said)


def test_find_says_what_it_needs_and_runs_an_example_by_a_click(
    sample: UiServer, visit: Visit
) -> None:
    page = visit(sample, "#at=0&panel=find")
    page.get_by_role("button", name="Find", exact=True).click()
    expect(page.locator("#panel .error")).to_contain_text("click an example")
    page.get_by_role("button", name="object_count() >= 10").click()
    expect(page.locator(".summary")).to_contain_text("Became true by event")
    expect(page.locator("#condition")).to_have_value("object_count() >= 10")
    assert moment(page) > 0


def test_comparing_two_moments_says_and_draws_what_changed(
    sample: UiServer, visit: Visit, mapfold: Commands
) -> None:
    plain = pixels(visit(sample, "#at=349&panel=compare"))
    page = visit(sample, "#at=348&panel=compare")
    page.get_by_label("From the start of").select_option(label="the moment shown")
    page.get_by_role("button", name="Next event").click()
    expect(page.locator("ul.changes")).to_contain_text("1 place gone")
    expect(page.locator(".note")).to_contain_text("only a map with fusion by evidence knows")
    expect(page.locator(".counts")).to_have_text("1 new keyframe, 101 keyframes in another place")
    page.get_by_text("How the two maps differ").click()
    expect(page.locator(".lines")).to_contain_text("digest 1a57d958a6bbab51 → 081f0c5b26250711")
    assert words(page.locator(".lines").inner_text()) == words(run_shown(page, mapfold, "--all"))
    other_pixels(page, plain)


def test_comparing_two_settings_shows_two_maps_with_one_view(
    sample: UiServer, visit: Visit, mapfold: Commands
) -> None:
    page = visit(sample, "#at=445&panel=compare")
    page.get_by_text("Two settings").click()
    slider = page.get_by_role("slider", name="ε, metres")
    slider.fill("0.75")
    expect(page.locator("canvas.map")).to_have_count(2)
    expect(page.locator(".panel")).to_contain_text("Folded in")
    expect(page.locator(".pane-title").nth(1)).to_contain_text("10 places, ε 0.75 m, min_samples 8")
    expect(page.locator(".panel")).to_contain_text("The places differ from event 31 on")
    assert "places differ from offset 31 on" in run_shown(page, mapfold)
    before = pixels(page), pixels(page, "other")
    assert before[0] != before[1]
    page.locator("canvas[data-side=main]").hover(position={"x": 100, "y": 200})
    page.mouse.wheel(0, -400)
    page.mouse.move(2, 2)
    other_pixels(page, before[0])
    other_pixels(page, before[1], "other")
    expect(page.locator("table")).to_contain_text("agreement of places (ARI)")
    page.get_by_role("button", name="Back to the log’s settings").click()
    expect(page.locator("canvas.map")).to_have_count(1)


def test_finding_the_event_that_made_a_condition_true(
    sample: UiServer, visit: Visit, mapfold: Commands
) -> None:
    page = visit(sample, "#panel=find")
    field = page.get_by_role("combobox", name="Condition over the map")
    field.click()
    page.keyboard.type("same")
    expect(page.get_by_role("option").first).to_contain_text("same_place")
    page.keyboard.press("Tab")
    page.keyboard.type("sim-7-a:10")
    expect(page.get_by_role("option").first).to_contain_text("sim-7-a:10")
    page.keyboard.press("Tab")
    page.keyboard.type("sim-7-a:310")
    page.keyboard.press("Tab")
    expect(field).to_have_value("same_place('sim-7-a:10', 'sim-7-a:310')")
    page.keyboard.press("Enter")
    expect(page.locator(".summary")).to_contain_text("Became true by event 348")
    assert moment(page) == 349
    assert "became true at offset 348" in run_shown(page, mapfold)


def test_a_wrong_condition_is_shown_at_its_column(sample: UiServer, visit: Visit) -> None:
    page = visit(sample, "#panel=find")
    page.get_by_role("combobox", name="Condition over the map").fill("place_count() > 'x'")
    page.get_by_role("button", name="Find", exact=True).click()
    expect(page.get_by_role("alert")).to_contain_text("cannot compare a number with a text")
    assert page.locator(".pointer").inner_text().split("\n")[1] == " " * 16 + "^"


@pytest.fixture(scope="module")
def two_runs(mapfold: Commands, tmp_path_factory: pytest.TempPathFactory) -> Iterator[UiServer]:
    """The sample's run, and another drive through the same house."""
    folder = tmp_path_factory.mktemp("two")
    for run in ("a", "b"):
        mapfold("simulate", "--run", run, "--out", folder / f"{run}.jsonl")
    mapfold("import", folder / "log", folder / "a.jsonl", folder / "b.jsonl")
    with showing(
        mapfold, folder / "log", "--set", "eps_m=0.75", "--set", "min_samples=8"
    ) as server:
        yield server


def test_a_lost_robot_is_found_by_the_map_before_its_run(
    two_runs: UiServer, visit: Visit, pictures: Path
) -> None:
    page = visit(two_runs, "#at=700&panel=lost")
    plain = pixels(page)
    keyframe, question = _question(two_runs)
    page.get_by_label("A keyframe whose crops").fill(keyframe)
    page.get_by_role("button", name="Where is it?").click()
    expect(page.locator(".ranked > li")).not_to_have_count(0)
    assert moment(page) == 700
    expect(page.locator("#panel .note")).to_contain_text("that of 445 events")  # the first run
    got = two_runs.ask("/api/relocalize", method="POST", body=json.dumps(question).encode(), at=445)
    found = got.json
    expect(page.locator(".ranked > li").first).to_contain_text(f"{found['places'][0]['score']:.3f}")
    expect(page.locator(".summary")).to_contain_text("The true pose is")
    page.mouse.move(2, 2)
    other_pixels(page, plain)
    page.screenshot(path=pictures / "lost.png")
    page.get_by_role("button", name="Show it").click()
    assert moment(page) == 445


def test_lost_opens_with_crops_of_the_last_run_of_which_some_are_chosen(
    two_runs: UiServer, visit: Visit, pictures: Path
) -> None:
    page = visit(two_runs, "#panel=lost")
    picked = two_runs.api("question")
    assert picked["keyframe"].startswith("sim-7-b/")
    crops = picked["question"]["crops"]
    assert len(crops) > 2
    opened = page.get_by_label("A keyframe whose crops")
    expect(opened).to_have_value(picked["keyframe"].replace("/", ":"))
    buttons = page.locator(".choose button")
    expect(buttons).to_have_count(len(crops))
    for button in buttons.all()[1:]:
        button.click()
    expect(page.locator(".choose")).to_contain_text(f"1 crop of {len(crops)}")
    with page.expect_request("**/api/relocalize*") as asked:
        page.get_by_role("button", name="Where is it?").click()
    assert [each["det_id"] for each in asked.value.post_data_json["crops"]] == [crops[0]["det_id"]]
    body = json.dumps({"crops": crops[:1]}).encode()
    path = f"/api/relocalize?at={picked['ask_at']}"
    _, *others = two_runs.ask(path, method="POST", body=body).json["spots"]
    assert others  # one thing is seen from several spots
    for spot in others:
        said = f"at ({spot['x']:.1f}, {spot['y']:.1f}) m, {spot['share']:.0%}".replace("%", " %")
        expect(page.locator("#panel .answer")).to_contain_text(said)
    page.screenshot(path=pictures / "lost-spots.png")
    buttons.first.click()
    expect(page.get_by_role("button", name="Where is it?")).to_be_disabled()


def test_a_click_on_the_map_asks_from_there(two_runs: UiServer, visit: Visit) -> None:
    page = visit(two_runs, "#panel=lost")
    answered(page)
    field = page.get_by_label("A keyframe whose crops")
    before = field.input_value()
    with page.expect_request("**/api/question?near=*") as asked:
        page.locator("canvas.map").click(position={"x": 300, "y": 240})
    expect(page.locator(".summary")).to_be_visible()
    near = parse_qs(urlparse(asked.value.url).query)["near"][0]
    nearest = two_runs.api("question", near=near)["keyframe"].replace("/", ":")
    assert field.input_value() == nearest != before
    expect(page.get_by_role("tab", name="Lost")).to_have_attribute("aria-selected", "true")


def test_with_one_run_the_whole_map_is_asked_and_the_page_says_so(
    rooms: UiServer, visit: Visit, pictures: Path
) -> None:
    page = visit(rooms, "#panel=lost")
    through = moment(page)
    expect(page.locator("#panel .note")).to_contain_text("so the whole map is asked")
    with page.expect_request("**/api/relocalize*") as asked:
        page.get_by_role("button", name="Where is it?").click()
    assert asked.value.url.endswith(f"at={through}")
    expect(page.locator(".ranked > li")).not_to_have_count(0)
    assert moment(page) == through
    page.screenshot(path=pictures / "lost-one-run.png")


def _question(server: UiServer) -> tuple[str, Any]:
    """A keyframe of the second run that saw three things, and its question."""
    for number in range(100, 300):
        got = server.ask("/api/question", keyframe=f"sim-7-b/{number}")
        if got.status == 200 and len(got.json["question"]["crops"]) > 2:
            return f"sim-7-b/{number}", got.json["question"]
    raise AssertionError("no keyframe saw three things")


def test_a_question_in_a_file_is_asked_and_one_that_is_none_refused(
    two_runs: UiServer, visit: Visit, tmp_path: Path
) -> None:
    question = tmp_path / "question.json"
    question.write_text(json.dumps(_question(two_runs)[1]))
    page = visit(two_runs, "#at=445&panel=lost")
    page.set_input_files("input[type=file]", question)
    expect(page.locator(".ranked > li")).not_to_have_count(0)
    bad = tmp_path / "bad.json"
    bad.write_text("{not json")
    page.set_input_files("input[type=file]", bad)
    expect(page.get_by_role("alert")).to_contain_text("bad.json is not JSON")


def test_the_way_between_two_things_is_shown_and_its_goal_is_copied(
    rooms: UiServer, visit: Visit, mapfold: Commands
) -> None:
    """What `mapfold path` answers: its length, its rooms and the pose at its end."""
    thing = rooms.api("find", what="sink", top=1)["answers"][0]["object_id"]
    begin, other = [each["place_id"] for each in rooms.api("overview")["rooms"][:2]]
    page = visit(rooms, f"#select=object:{thing}&panel=why")
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    plain = pixels(page)
    page.get_by_label("Way here from").select_option(begin)
    way = page.locator("section.way")
    expect(way.locator(".command code")).to_have_text(re.compile("mapfold path .*"))
    line = shlex.split(way.locator(".command code").inner_text())
    said = mapfold(*line[1:], "--json").json
    expect(way).to_contain_text(f"{said['length_m']:.1f} m")
    expect(way).to_contain_text(f"{said['goal']['distance_m']:.2f} m away")
    other_pixels(page, plain)
    way.get_by_role("button", name="Copy the goal as YAML").click()
    expect(page.locator(".notice")).to_contain_text("Copied the goal as YAML")
    copied = page.evaluate("() => navigator.clipboard.readText()")
    assert copied == mapfold(*line[1:], "--goal", "yaml").out
    expect(page).to_have_url(re.compile(f"from={begin}"))
    page.get_by_label("Way here from").select_option("goal")
    expect(way.locator(".command code")).to_have_text(re.compile("mapfold find .* --goal yaml"))
    assert rooms.api("path", to=thing)["yaml"] == copied
    there = visit(rooms, f"#select=place:{other}&panel=why&from={begin}")
    way = there.locator("section.way")
    expect(way.get_by_label("Way here from")).to_have_value(begin)
    found = rooms.api("path", **{"from": begin, "to": other})
    expect(way).to_contain_text(f"{found['path']['length_m']:.1f} m")
    expect(way.get_by_role("button", name="Copy the goal")).to_have_count(0)
    there.get_by_label("Way here from").select_option("robot")
    expect(way.locator(".command code")).to_have_text(re.compile(r"mapfold path \S+ -?\d+\.\d+,"))
