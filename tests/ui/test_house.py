"""The page on a drive through a real house's layout, where the trial data is at hand."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import expect

from tests.support.commands import Commands
from tests.support.shared_data import shared_run
from tests.support.ui_page import UiServer, showing
from tests.ui.conftest import Visit
from tests.ui.test_moments import check_digests, moment

SETTINGS = ("--set", "eps_m=0.75", "--set", "min_samples=8", "--set", "fusion=evidence")
House = tuple[Path, UiServer]


@pytest.fixture(scope="module")
def house(mapfold: Commands, tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    folder = tmp_path_factory.mktemp("house")
    (folder / "house-a.jsonl").write_bytes(b"\n".join(shared_run("house-a")))
    mapfold("import", folder / "log", folder / "house-a.jsonl")
    with showing(mapfold, folder / "log", *SETTINGS) as server:
        yield folder / "log", server


def test_the_digest_shown_is_that_of_state_at_200_moments(
    house: House, visit: Visit, mapfold: Commands
) -> None:
    log, server = house
    check_digests(visit(server), mapfold, log, SETTINGS, seed=20)


def test_each_merge_is_reached_and_explained(house: House, visit: Visit, mapfold: Commands) -> None:
    log, server = house
    merges = mapfold("merges", log, *SETTINGS, "--json").json
    assert merges
    page = visit(server, "#at=0&panel=why")
    for merge in {each["offset"]: each for each in merges}.values():
        page.keyboard.press("m")
        assert moment(page) == merge["offset"] + 1
        survivor = merge["survivor"].rpartition("_")[2]
        expect(page.locator(".summary")).to_contain_text(f"{survivor} absorbed")
        expect(page.locator(".lines")).to_contain_text(f"at offset {merge['offset']}")


def test_moments_settings_and_conditions_are_compared_and_found(
    house: House, visit: Visit, mapfold: Commands
) -> None:
    log, server = house
    last = mapfold("merges", log, *SETTINGS, "--json").json[-1]
    at = last["offset"] + 1
    page = visit(server, f"#at={at}&panel=compare&with={at - 1}")
    expect(page.locator("ul.changes")).to_contain_text("place gone")
    page.get_by_text("Two settings").click()
    page.get_by_role("slider", name="ε, metres").fill("0.5")
    expect(page.locator("canvas.map")).to_have_count(2)
    expect(page.locator("table")).to_contain_text("agreement of places (ARI)", timeout=60_000)
    page.get_by_role("tab", name="Find").click()
    asked = f"merged('{last['absorbed'][0]}')"
    page.get_by_role("combobox", name="Condition over the map").fill(asked)
    page.get_by_role("button", name="Find", exact=True).click()
    expect(page.locator(".summary")).to_contain_text(f"Became true by event {last['offset']}")


def test_a_keyframe_of_the_drive_is_asked_for(house: House, visit: Visit) -> None:
    _, server = house
    keyframe = next(
        f"house-a/{number}"
        for number in range(700, 900)
        if server.ask("/api/question", keyframe=f"house-a/{number}").status == 200
    )
    page = visit(server, "#panel=lost")
    page.get_by_label("A keyframe whose crops").fill(keyframe)
    page.get_by_role("button", name="Where is it?").click()
    expect(page.locator(".summary")).to_contain_text("The true pose is")
    assert moment(page) == 912  # a question does not move the timeline
