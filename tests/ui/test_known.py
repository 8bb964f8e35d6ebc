"""As known then, as known now: the map under the corrections before W, or under all of them."""

import re
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from tests.support.commands import Commands
from tests.support.ui_page import UiServer, showing
from tests.ui.browser import digest
from tests.ui.conftest import SAMPLE, WIDE, Visit
from tests.ui.test_moments import go, moment

MERGE = 348
Corrected = tuple[Path, UiServer]


@pytest.fixture(scope="module")
def corrected(mapfold: Commands, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Corrected]:
    """The sample, in which a merge is undone at 445 and a place named at 446."""
    log = Path(shutil.copytree(SAMPLE, tmp_path_factory.mktemp("corrected") / "log"))
    mapfold("edit", log, "undo-merge", str(MERGE), "--reason", "a door", *WIDE)
    mapfold("edit", log, "name-place", "sim-7-a_p5", "den", "--reason", "so called", *WIDE)
    with showing(mapfold, log, *WIDE) as server:
        yield log, server


def choose(page: Page, which: str) -> None:
    page.get_by_role("radio", name=f"As known {which}").check(force=True)


def shown(page: Page) -> None:
    """Wait until the map is the one chosen; until it is loaded the page shows the other."""
    busy = page.get_by_role("group", name="Corrections in force")
    expect(busy).to_have_attribute("aria-busy", "false")


def check(page: Page, mapfold: Commands, log: Path, at: int, *words: str) -> None:
    """The digest shown is that of ``state``."""
    said = mapfold("state", log, *WIDE, "--at", str(at), *words, "--digest").out.strip()
    digest(page)
    expect(page.locator(".facts code")).to_have_attribute("data-digest", said)


def test_the_map_is_that_of_state_as_known_then_and_as_known_now(
    corrected: Corrected, visit: Visit, mapfold: Commands
) -> None:
    log, server = corrected
    page = visit(server, f"#at={MERGE + 1}")
    check(page, mapfold, log, MERGE + 1, "--known-at", "end")
    expect(page.locator(".facts")).to_contain_text("8 places")
    choose(page, "then")
    check(page, mapfold, log, MERGE + 1)
    expect(page.locator(".facts")).to_contain_text("7 places")
    for at in (MERGE, 445, 446, 447, 100):
        go(page, at)
        check(page, mapfold, log, at)
    choose(page, "now")
    check(page, mapfold, log, 100, "--known-at", "end")
    go(page, 447)
    check(page, mapfold, log, 447)
    expect(page.locator("table.rooms")).to_contain_text("den")


def test_the_link_says_what_is_known_and_why_answers_so(
    corrected: Corrected, visit: Visit, mapfold: Commands
) -> None:
    page = visit(corrected[1], f"#at={MERGE + 1}&known=then&select=merge:{MERGE}&panel=why")
    expect(page.locator(".summary")).to_have_text("p0 absorbed p7")
    assert page.get_by_role("radio", name="As known then").is_checked()
    line = page.locator("#panel .command code").inner_text()
    assert "--known-at" not in line  # it is what the command says by itself
    said = mapfold(*shlex.split(line)[1:]).out
    assert f"merge 2 at offset {MERGE}" in said
    choose(page, "now")
    expect(page.locator(".summary")).to_have_text("p0 and p7 did not merge: refused")
    said = mapfold(*shlex.split(page.locator("#panel .command code").inner_text())[1:]).out
    assert "a door" in said
    expect(page).not_to_have_url(re.compile("known="))
    choose(page, "then")
    expect(page).to_have_url(re.compile("known=then"))


def test_marks_of_the_timeline_are_those_of_what_is_known(
    corrected: Corrected, visit: Visit
) -> None:
    page = visit(corrected[1], "#at=0&known=then")
    shown(page)
    for _ in range(2):
        page.keyboard.press("m")
    assert moment(page) == MERGE + 1
    choose(page, "now")
    expect(page.locator(".facts")).to_contain_text("8 places")
    page.keyboard.press("Home")
    for _ in range(2):
        page.keyboard.press("m")
    assert moment(page) != MERGE + 1


def test_a_log_without_corrections_offers_no_choice(sample: UiServer, visit: Visit) -> None:
    expect(visit(sample).get_by_role("radio", name="As known then")).to_have_count(0)


def test_the_line_that_the_demo_ends_with_shows_its_merge(
    mapfold: Commands, visit: Visit, tmp_path: Path
) -> None:
    played = mapfold("demo", "--speed", "300", "--out", tmp_path / "demo").err.splitlines()
    line = played[-1].partition("#")[0].strip()
    program, command, *words = shlex.split(line)
    assert (program, command) == ("mapfold", "ui")
    offset = int(words[-1].removeprefix("merge:"))
    with showing(mapfold, *words) as server:
        link = server.said[0].partition(" at ")[2]
        page = visit(server, "#" + link.partition("#")[2])
        assert moment(page) == offset + 1
        expect(page.locator(".thing h2")).to_have_text(f"Merge by event {offset}")
        expect(page.locator(".summary")).to_contain_text("absorbed")
        expect(page.locator(".mini canvas")).to_have_count(2)
