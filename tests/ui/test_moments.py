"""Points 1 and 2: the map at W, and dragging, playing and stepping through time."""

import random
import re
from pathlib import Path
from typing import Any

from playwright.sync_api import Page, expect

from eventsrc.log import LogReader
from projections.fold.semantic_map import SemanticMap
from projections.fold.settings import Settings
from projections.map.digest import map_digest
from projections.map.fold import fold_events
from projections.map.view import MapView
from tests.support.commands import Commands
from tests.support.ui_page import UiServer
from tests.ui.browser import digest, other_pixels, pixels, point_over, wait_for_pixels
from tests.ui.conftest import SAMPLE, WIDE, Visit


def state(mapfold: Commands, at: int) -> dict[str, Any]:
    return mapfold("state", SAMPLE, *WIDE, "--at", str(at), "--json").json  # type: ignore[no-any-return]


def go(page: Page, at: int) -> None:
    page.get_by_label("Moment: number of events").fill(str(at))
    page.get_by_label("Moment: number of events").press("Enter")


def moment(page: Page) -> int:
    return int(page.get_by_role("slider", name="Moment").get_attribute("aria-valuenow") or "-1")


def test_the_map_at_a_moment_is_that_of_state(
    sample: UiServer, visit: Visit, mapfold: Commands
) -> None:
    """Counts, places, digest, what is under the pointer, and search."""
    page = visit(sample, "#at=349")
    expect(page.locator(".facts")).to_contain_text("7 places")
    expect(page.locator(".facts")).to_contain_text("349 keyframes")
    expect(page.locator(".facts")).to_contain_text("35 objects + 36 seen once")
    places = [each["place_id"] for each in state(mapfold, 349)["places"]]
    rows = page.locator("table.rooms tbody tr")
    expect(rows).to_have_count(len(places))
    said = " ".join(rows.all_inner_texts())
    assert sorted(re.findall(r"\bp\d+\b", said)) == sorted(p.split("_")[1] for p in places)
    expect(page.get_by_role("img", name="Map after 349 events: 349 keyframes")).to_be_visible()

    page.keyboard.press("/")
    page.keyboard.type("p5")
    page.keyboard.press("Enter")
    expect(page.locator(".thing h2")).to_have_text("p5")
    expect(page.locator(".thing code")).to_have_text("sim-7-a_p5")
    expect(page).to_have_url(re.compile("select=place%3Asim-7-a_p5"))
    box = page.locator("canvas.map").bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.get_by_label("Search places").fill("bathtub")
    expect(page.get_by_role("option").first).to_contain_text("bathtub")


def test_search_is_find_and_its_answers_are_walked_on_the_map(
    rooms: UiServer, visit: Visit
) -> None:
    answers = rooms.api("find", what="chairs", top=20)["answers"]
    assert len(answers) >= 3
    page = visit(rooms)
    plain = pixels(page)
    search = page.get_by_label("Search places")
    search.fill("chairs")
    shown = page.get_by_role("option")
    expect(shown.first).to_contain_text(answers[0]["object_id"][:10])
    for option, answer in zip(shown.all(), answers, strict=False):
        expect(option).to_contain_text(f"seen {answer['obs_count']} times")
        expect(option).to_contain_text(answer["last_seen"]["iso"][:16].replace("T", " "))
        expect(option).to_contain_text(answer["place_type"] or answer["place_id"])
    first = other_pixels(page, plain)  # all of them marked
    search.press("ArrowDown")
    expect(shown.nth(1)).to_have_attribute("aria-selected", "true")
    other_pixels(page, first)
    search.press("Enter")
    expect(page).to_have_url(re.compile(f"select=object%3A{answers[1]['object_id']}"))
    search.fill("kitchen")
    expect(shown.first).to_contain_text("kitchen")
    expect(shown.first).to_contain_text("place")
    search.fill("unicorn")
    expect(shown.first).to_contain_text("no class like 'unicorn'")


def test_hovering_tells_what_is_there_and_a_click_selects_it(
    sample: UiServer, visit: Visit
) -> None:
    page = visit(sample)
    plain = pixels(page)
    at = point_over(page, "sim-7-a_p6")
    other_pixels(page, plain)
    page.mouse.click(*at)
    expect(page.locator(".thing h2")).to_have_text("p6")
    expect(page.locator(".facts-list")).to_contain_text("79")


def test_zooming_and_panning_move_the_map_and_the_whole_map_comes_back(
    sample: UiServer, visit: Visit
) -> None:
    page = visit(sample)
    whole = pixels(page)
    page.locator("canvas.map").hover(position={"x": 300, "y": 200})
    page.mouse.wheel(0, -600)
    page.mouse.move(2, 2)
    near = other_pixels(page, whole)
    page.locator("canvas.map").hover(position={"x": 300, "y": 200})
    page.mouse.down()
    page.mouse.move(500, 300, steps=4)
    page.mouse.up()
    page.mouse.move(2, 2)
    panned = other_pixels(page, near)
    assert panned != whole
    page.keyboard.press("Alt+ArrowLeft")
    assert other_pixels(page, panned) not in (whole, near)
    page.keyboard.press("f")
    wait_for_pixels(page, whole)


def test_dragging_the_timeline_shows_each_moment_as_state_does(
    sample: UiServer, visit: Visit, mapfold: Commands
) -> None:
    page = visit(sample)
    track = page.get_by_role("slider", name="Moment")
    box = track.bounding_box()
    assert box is not None
    y = box["y"] + box["height"] * 0.6
    page.mouse.move(box["x"] + box["width"] - 14, y)
    page.mouse.down()
    seen = []
    for share in (0.8, 0.55, 0.3, 0.62):
        page.mouse.move(box["x"] + box["width"] * share, y, steps=5)
        seen.append(moment(page))
    page.mouse.up()
    assert seen[:3] == sorted(seen[:3], reverse=True)
    assert seen[2] < seen[3] < seen[0]
    assert digest(page) == state(mapfold, seen[3])["digest"]
    expect(page.locator(".facts")).to_contain_text(f"{seen[3]} keyframes")
    expect(page).to_have_url(re.compile(f"at={seen[3]}&"))


def test_the_digest_shown_is_that_of_state_at_200_moments(
    sample: UiServer, visit: Visit, mapfold: Commands
) -> None:
    check_digests(visit(sample), mapfold, SAMPLE, WIDE, seed=19)


_JUMP = """at => {
    const field = document.querySelector("input.at");
    field.value = at;
    field.dispatchEvent(new Event("change", { bubbles: true }));
}"""
_DIGEST = """() => document.querySelector(".facts code").dataset.digest"""


def check_digests(
    page: Page, mapfold: Commands, log: Path, sets: tuple[str, ...], *, seed: int
) -> None:
    """At 200 random W and both ends the page shows the digest of the fold of the events before W,
    made one by one here; at some of them ``state`` is asked too. Waiting for the slider to rest is
    skipped with the browser's clock."""
    settings = Settings().with_assignments(sets[1::2])
    wanted = [map_digest(MapView(settings))]
    with LogReader(log) as reader:
        view = MapView(settings)
        for event in fold_events(reader.read(), SemanticMap(settings)):
            view.apply_event(event.offset, event.deltas)
            wanted.append(map_digest(view))
    chosen = random.Random(seed)
    moments = [0, len(wanted) - 1, *(chosen.randrange(len(wanted)) for _ in range(200))]
    digest(page)
    page.clock.install()
    for at in moments:
        page.evaluate(_JUMP, at)
        page.clock.run_for(250)
        page.wait_for_function(_DIGEST)
        assert page.evaluate(_DIGEST) == wanted[at], at
    for at in moments[:5]:
        said = mapfold("state", log, *sets, "--at", str(at), "--digest").out.strip()
        assert said == wanted[at]


def test_keys_and_buttons_step_by_event_change_and_merge(
    sample: UiServer, visit: Visit, mapfold: Commands
) -> None:
    merges = [m["offset"] + 1 for m in mapfold("merges", SAMPLE, *WIDE, "--json").json]
    page = visit(sample, "#at=340&panel=why")
    page.keyboard.press("ArrowRight")
    assert moment(page) == 341
    page.get_by_role("button", name="Previous event").click()
    assert moment(page) == 340
    for wanted in (m for m in merges if m > 340):
        page.keyboard.press("m")
        assert moment(page) == wanted
    page.keyboard.press("Shift+M")
    assert moment(page) == merges[-2]
    expect(page.locator(".thing h2")).to_have_text(f"Merge by event {merges[-2] - 1}")
    page.keyboard.press("Home")
    assert moment(page) == 0
    page.keyboard.press("Shift+ArrowRight")
    assert moment(page) == 8  # the first place is founded by the event at 7
    page.keyboard.press("End")
    assert moment(page) == 445


def test_playing_goes_on_to_the_end_and_stops(sample: UiServer, visit: Visit) -> None:
    page = visit(sample, "#at=0")
    page.get_by_label("Speed of playing").select_option("100")
    page.keyboard.press(" ")
    expect(page.get_by_role("button", name="Pause")).to_be_visible()
    slider = page.get_by_role("slider", name="Moment")
    expect(slider).to_have_attribute("aria-valuenow", "445", timeout=30_000)
    expect(page.get_by_role("button", name="Play", exact=True)).to_be_visible()


def test_a_mark_on_the_timeline_leads_to_its_moment(
    sample: UiServer, visit: Visit, mapfold: Commands
) -> None:
    """By time too: the axis has another scale, the marks lead to the same moments."""
    offset = mapfold("merges", SAMPLE, *WIDE, "--json").json[2]["offset"]
    for clock in ("", "&clock=time"):
        page = visit(sample, f"#at=100{clock}")
        box = page.get_by_role("slider", name="Moment").bounding_box()
        assert box is not None
        for x in range(int(box["width"] * 0.5), int(box["width"]), 5):
            page.mouse.move(box["x"] + x, box["y"] + 9)
            if page.locator(".tip").count() and str(offset) in page.locator(".tip").inner_text():
                page.mouse.click(box["x"] + x, box["y"] + 9)
                break
        assert moment(page) == offset + 1
        expect(page.locator(".thing h2")).to_have_text(f"Merge by event {offset}")


def test_the_address_shows_a_colleague_the_same_moment(sample: UiServer, visit: Visit) -> None:
    first = visit(sample)
    go(first, 300)
    first.get_by_role("tab", name="Find").click()
    expect(first).to_have_url(re.compile("#at=300&.*panel=find"))
    second = visit(sample, f"#{first.url.partition('#')[2]}")
    assert moment(second) == 300
    expect(second.get_by_role("tab", name="Find")).to_have_attribute("aria-selected", "true")
