"""Pictures of the page in its states, to be looked at: ``build/ui-pictures``. Each must show
something: no error, nothing wider than the window."""

from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from tests.support.ui_page import UiServer
from tests.ui.browser import answered, whole
from tests.ui.conftest import SCHEMES, SIZES, Visit

STATES = {
    "whole": "",
    "merge": "#at=349&select=merge:348&panel=why",
    "drag": "#at=200&panel=why&clock=time",
    "why": "#at=445&select=place:sim-7-a_p7&panel=why",
    "diff": "#at=349&panel=compare&with=348",
    "whatif": "#at=445&panel=compare&eps_m=0.75&min_samples=8",
    "find": "#panel=find",
    "lost": "#panel=lost",
    "correct": "#panel=correct",
    "closed": "#panel=none",
}


@pytest.mark.parametrize(("size", "scheme"), SCHEMES.items())
def test_pictures(sample: UiServer, visit: Visit, pictures: Path, size: str, scheme: str) -> None:
    width, height = SIZES[size]
    page = visit(sample, viewport={"width": width, "height": height}, color_scheme=scheme)
    origin = page.url.partition("#")[0]
    for state, address in STATES.items():
        page.goto("about:blank")
        page.goto(origin + address)
        page.wait_for_selector("html[data-painted]")
        whole(page)
        _settled(page, state)
        page.screenshot(path=pictures / f"{state}-{size}-{scheme}.png")
        assert page.evaluate("() => document.documentElement.scrollWidth") <= width
        expect(page.locator("#panel .error")).to_have_count(0)


def test_the_picture_of_the_readme(rooms: UiServer, visit: Visit, pictures: Path) -> None:
    """``docs/images/ui.png`` is a copy of it."""
    viewport = {"width": 1440, "height": 900}
    page = visit(rooms, "#at=305&select=merge:304&panel=why", viewport=viewport)
    expect(page.locator(".summary")).to_contain_text("p0 absorbed p4")
    _settled(page, "merge")
    page.screenshot(path=pictures / "readme.png")


def _settled(page: Page, state: str) -> None:
    if state in ("merge", "why"):
        page.locator("#panel .command").wait_for()
    if state == "diff":
        page.get_by_text("How the two maps differ").wait_for()
    if state == "whatif":
        page.locator("table").wait_for()
    answered(page)
