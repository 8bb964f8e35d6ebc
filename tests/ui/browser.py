"""A headless chromium that sends requests to the server under test only."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from playwright.sync_api import Browser, Page, expect, sync_playwright

ARGUMENTS = (
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
WAIT_MS = 30_000
expect.set_options(timeout=WAIT_MS)


def program() -> str | None:
    """Where chromium is: what ``MAPFOLD_CHROMIUM`` names, else Debian's."""
    return os.environ.get("MAPFOLD_CHROMIUM") or shutil.which("chromium")


@contextmanager
def browser(folder: Path) -> Iterator[Browser]:
    """A browser of its own, whose home is in ``folder``."""
    with sync_playwright() as playwright:
        home = {**os.environ, "HOME": str(folder), "XDG_CONFIG_HOME": str(folder / "config")}
        started = playwright.chromium.launch(
            executable_path=program(), args=list(ARGUMENTS), env=home
        )
        try:
            yield started
        finally:
            started.close()


def opened(page: Page, url: str) -> Page:
    """The page at ``url``, when its map is drawn."""
    page.goto("about:blank")
    page.goto(url)
    page.wait_for_selector("html[data-painted]", timeout=WAIT_MS)
    answered(page)
    return page


_TWO_FRAMES = """() => new Promise(done =>
    requestAnimationFrame(() => requestAnimationFrame(() => setTimeout(done))))"""


def answered(page: Page) -> None:
    """Waits until every question of the page has its answer. A part of the page asks, and draws on
    a canvas of its own, in the frame after it is there."""
    page.evaluate(_TWO_FRAMES)
    page.wait_for_selector("html[data-unanswered='0']", timeout=WAIT_MS)
    page.evaluate(_TWO_FRAMES)


def whole(page: Page) -> None:
    """Waits until the page has what the server knows about the map shown."""
    page.wait_for_selector(".facts[data-whole=true]", timeout=WAIT_MS)


def digest(page: Page) -> str:
    """The digest of the map, when the page has it; it is shown on demand."""
    asked = page.get_by_role("button", name="digest")
    if asked.get_attribute("aria-expanded") != "true":
        asked.click()
    shown = page.locator(".facts code[data-digest]:not([data-digest=''])")
    shown.wait_for()
    return shown.get_attribute("data-digest") or ""


_DRAWN = "document.querySelector(`canvas[data-side=${side}]`).toDataURL()"


def pixels(page: Page, side: str = "main") -> str:
    """What a map's canvas shows, without what lies over it, when drawing has rested: also the types
    of places, which come from the server."""
    whole(page)
    answered(page)
    before = ""
    while (now := str(page.evaluate(f"side => {_DRAWN}", side))) != before:
        before = now
        page.evaluate(_TWO_FRAMES)
    return now


def other_pixels(page: Page, before: str, side: str = "main") -> str:
    """Those of the canvas when it shows something else than ``before``."""
    page.wait_for_function(f"([side, before]) => {_DRAWN} !== before", arg=[side, before])
    return pixels(page, side)


def wait_for_pixels(page: Page, wanted: str) -> None:
    """Waits until the canvas of the map shows them."""
    page.wait_for_function(f"([side, wanted]) => {_DRAWN} === wanted", arg=["main", wanted])


def point_over(page: Page, name: str) -> tuple[float, float]:
    """A point of the window where the pointer is over the thing of this name or id."""
    box = page.locator("canvas.map").bounding_box()
    assert box is not None
    for share in (0.44, 0.5, 0.38, 0.6):
        for x in range(40, int(box["width"]) - 40, 12):
            at = box["x"] + x, box["y"] + box["height"] * share
            page.mouse.move(*at)
            tip = page.locator(".tip div")
            if name in (line.strip("\u2068\u2069") for line in tip.all_inner_texts()):
                return at
    raise AssertionError(f"{name} is nowhere under the pointer")
