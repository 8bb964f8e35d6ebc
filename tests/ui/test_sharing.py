"""A link has all that the page shows; a saved page has the map at all moments and needs no
server."""

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import pytest
from playwright.sync_api import Browser, Page, expect

from tests.support.commands import Commands
from tests.support.envelopes import detection, envelope
from tests.support.logs import SAMPLE, append_command, name_place, write_log
from tests.support.ui_page import UiServer
from tests.ui.browser import answered, digest, opened, other_pixels, pixels, wait_for_pixels
from tests.ui.conftest import Visit


def parts(page: Page, settled: str) -> dict[str, list[str]]:
    """What the address says, once it has the part ``settled``, a regular expression."""
    expect(page).to_have_url(re.compile(settled))
    return parse_qs(urlsplit(page.url).fragment)


def test_a_link_opens_the_page_as_it_was(rooms: UiServer, visit: Visit) -> None:
    page = visit(rooms)
    whole = pixels(page)
    assert "box" not in page.url
    page.get_by_label("Moment: number of events").fill("300")
    page.get_by_label("Moment: number of events").press("Enter")
    page.get_by_label("Only objects that are").fill("chair")
    page.get_by_role("checkbox", name="seen once", exact=True).check()
    page.get_by_role("columnheader", name="class").get_by_role("button").click()
    found = rooms.api("find", what="chair", at=300, known_at=rooms.api("log")["through"])
    room = found["answers"][0]["place_id"]
    page.get_by_label("Only objects in").select_option(room)
    for _ in range(3):
        page.get_by_role("button", name="Zoom in").click()
    other_pixels(page, whole)
    said = parts(page, "box=")
    assert said["at"] == ["300"]
    assert said["what"] == ["chair"]
    assert said["once"] == ["1"]
    assert said["sort"] == ["class"]
    assert said["in"] == [room]
    table = page.locator("table.objects").inner_text()
    there = visit(rooms, "#" + urlsplit(page.url).fragment)
    assert there.locator("table.objects").inner_text() == table
    assert parts(there, "box=") == said  # the same part of the map
    assert pixels(there) != whole


def test_a_link_has_the_layers_the_comparison_and_the_condition(
    rooms: UiServer, visit: Visit
) -> None:
    page = visit(rooms, "#at=440&panel=find&if=place_count()>2&layers=path,labels")
    expect(page.locator(".answer")).to_contain_text("Became true by event")
    assert parts(page, "layers=")["layers"] == ["path,labels"]
    page.get_by_role("tab", name="Compare").click()
    page.get_by_text("Two settings").click()
    assert parts(page, "compare=")["compare"] == ["settings"]
    there = visit(rooms, "#" + urlsplit(page.url).fragment)
    expect(there.get_by_role("radio", name="Two settings")).to_be_checked()


def test_a_link_shows_the_same_part_of_the_map_in_another_window(
    rooms: UiServer, visit: Visit
) -> None:
    """Also when it is pasted into a page that is open already."""
    box = "box=2,1,6,4"
    small = visit(rooms, f"#panel=none&{box}", viewport={"width": 500, "height": 700})
    assert parts(small, "box=")["box"] == ["2,1,6,4"]
    page = visit(rooms, "#panel=none")
    whole = pixels(page)
    page.evaluate("hash => (location.hash = hash)", f"panel=none&{box}")
    other_pixels(page, whole)
    page.evaluate("hash => (location.hash = hash)", "panel=none")
    expect(page).not_to_have_url(re.compile("box="))
    assert pixels(page) == whole


# A saved page


@pytest.fixture(scope="module")
def page_of_sample(mapfold: Commands, tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("saved") / "sample.html"
    done = mapfold("ui", SAMPLE, "--export-html", file)
    assert done.err.startswith(f"wrote file://{file}")
    return file


@contextmanager
def saved(chromium: Browser, file: Path, moment: str = "") -> Iterator[Page]:
    """The saved page, opened from the disk: it sends no request and logs no error."""
    context = chromium.new_context(accept_downloads=True, viewport={"width": 1280, "height": 720})
    faults: list[str] = []
    page = context.new_page()
    page.on("pageerror", lambda error: faults.append(f"error: {error}"))
    page.on("console", lambda said: faults.append(said.text))
    page.on("request", lambda asked: faults.append(asked.url))
    opened(page, f"file://{file}{moment}")
    yield page
    context.close()
    quiet = ("file:", "about:", "data:", "blob:")
    assert [each for each in faults if not each.startswith(quiet)] == []


def test_a_saved_page_is_small_and_the_same_each_time(
    mapfold: Commands, page_of_sample: Path, tmp_path: Path
) -> None:
    assert page_of_sample.stat().st_size <= 1_500_000
    log = write_log(tmp_path / "log", [envelope(k, x=0.2 * k) for k in range(9)])
    files = [tmp_path / "a.html", tmp_path / "b.html"]
    for file in files:
        mapfold("ui", log, "--export-html", file)
    assert files[0].read_bytes() == files[1].read_bytes()
    assert sorted(each.suffix for each in tmp_path.iterdir() if each.is_file()) == [".html"] * 2


def test_a_saved_page_shows_what_the_server_shows(
    chromium: Browser, rooms: UiServer, visit: Visit, page_of_sample: Path
) -> None:
    """The map, the tables and the story of a thing, at the end and at a moment before."""
    for moment in ("#panel=why", f"#at={rooms.api('log')['through'] // 2}&panel=why"):
        served = visit(rooms, moment)
        with saved(chromium, page_of_sample, moment) as page:
            for each in (".facts", "table.rooms", "table.objects"):
                expect(page.locator(each)).to_have_text(
                    served.locator(each).inner_text(), use_inner_text=True
                )
            assert pixels(page) == pixels(served)
            assert digest(page) == digest(served)
    thing = rooms.api("find", what="chair", top=1)["answers"][0]["object_id"]
    served = visit(rooms, f"#select=object:{thing}&panel=why")
    with saved(chromium, page_of_sample, f"#select=object:{thing}&panel=why") as page:
        story = page.locator(".story .steps")
        told = served.locator(".story .steps").inner_text()
        expect(story).to_have_text(told, use_inner_text=True)


def test_a_saved_page_can_be_looked_around_in(chromium: Browser, page_of_sample: Path) -> None:
    with saved(chromium, page_of_sample) as page:
        end = pixels(page)
        for tab in ("Find", "Lost", "Correct"):
            expect(page.get_by_role("tab", name=tab)).to_have_count(0)
        page.keyboard.press("5")  # no panel that needs a server
        page.keyboard.press("Home")
        expect(page.locator(".facts")).to_contain_text("0 keyframes")
        page.get_by_label("Moment: number of events").fill("301")
        page.get_by_label("Moment: number of events").press("Enter")
        expect(page.locator(".facts")).to_contain_text("299 keyframes")
        expect(page.locator(".panel")).to_contain_text("as of event")
        page.get_by_label("Moment: number of events").press("Escape")
        page.get_by_role("slider", name="Moment").press("End")
        wait_for_pixels(page, end)
        page.get_by_label("Only objects that are").fill("chair")
        rows = page.locator("table.objects tbody tr")
        expect(rows.filter(has_not_text="chair")).to_have_count(0)
        search = page.get_by_label("Search places")
        search.fill("chair")
        expect(page.get_by_role("option").first).to_contain_text("chair")
        search.press("Enter")
        expect(page.locator(".thing h2")).to_have_text("chair")
        expect(page.locator(".story .steps li").first).to_be_visible()
        search.fill("no such thing")
        expect(page.get_by_role("option").first).to_contain_text("No name in this saved page")
        search.press("Escape")
        page.get_by_role("tab", name="Compare").click()
        answered(page)
        expect(page.get_by_text("Two settings")).to_have_count(0)
        page.get_by_label("From the start of").select_option("the moment shown")
        expect(page.locator(".panel")).to_contain_text("saved without that answer")


def test_hostile_names_stay_names_in_a_saved_page(
    chromium: Browser, mapfold: Commands, tmp_path: Path
) -> None:
    end = "</script><script>document.title='broken'</script><!--"
    names = ["<img src=x onerror=alert(1)>", "a\"b'&amp;", end]
    seen = [detection(name, [1.0, 0.5]) for name in names]
    moments = [envelope(k, x=0.2 * k, detections=seen) for k in range(9)]
    log = write_log(tmp_path / "log </script>", moments)
    append_command(log, name_place(3, end))
    file = tmp_path / "page.html"
    mapfold("ui", log, "--export-html", file, "--select", "object:none", "--at", "5")
    with saved(chromium, file, "#panel=why") as page:
        expect(page.locator("table.objects tbody tr")).to_have_count(len(names))
        expect(page.locator("table.rooms")).to_contain_text(end[:29])
        assert "broken" not in page.title()
        assert page.evaluate("() => document.querySelectorAll('img').length") == 0
        assert page.evaluate("() => document.scripts.length") == 4


def test_a_page_that_cannot_be_written_leaves_nothing(mapfold: Commands, tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    refused = mapfold("ui", SAMPLE, "--export-html", tmp_path / "folder", code=2)
    assert "cannot be written" in refused.err
    assert list(tmp_path.iterdir()) == [tmp_path / "folder"]
    refused = mapfold("ui", SAMPLE, "--export-html", tmp_path / "a.html", "--open", code=2)
    assert "--export-html serves nothing" in refused.err
    assert json.dumps([each.name for each in tmp_path.iterdir()]) == '["folder"]'
