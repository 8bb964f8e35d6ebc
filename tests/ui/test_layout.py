"""Controls lie beside each other within the window, from a phone to a large screen."""

import pytest
from playwright.sync_api import Page, expect

from tests.support.ui_page import UiServer
from tests.ui.browser import answered, whole
from tests.ui.conftest import SIZES, Visit

_COVERED = """() => {
    const controls = "button, select, input:not(.hidden), summary, .facts, .scale, .legend label,"
        + " .segments label, .track, canvas.map, .bar h1, .time";
    const panel = document.querySelector("#panel");
    const inPanel = each => panel.contains(each);
    const shown = [...document.querySelectorAll(controls)].filter(each => each.checkVisibility())
        .map(each => [each, each.getBoundingClientRect()])
        .filter(([, box]) => box.width > 1 && box.height > 1);
    const name = each => each.getAttribute("aria-label") ?? (each.textContent || each.className);
    const outside = shown.filter(([each, box]) => !inPanel(each) && (box.left < -0.5
        || box.top < -0.5 || box.right > innerWidth + 0.5 || box.bottom > innerHeight + 0.5));
    const found = outside.map(([each]) => name(each) + " is outside");
    const over = document.querySelector("main.stage");
    for (const [a, at] of shown) for (const [b, on] of shown) {
        if (a === b || a.contains(b) || b.contains(a) || inPanel(a) !== inPanel(b)) continue;
        if (a.matches("canvas") && over.contains(b)) continue;  // it is made to lie on the map
        if (b.matches("canvas") && over.contains(a)) continue;
        const wide = Math.min(at.right, on.right) - Math.max(at.left, on.left);
        const high = Math.min(at.bottom, on.bottom) - Math.max(at.top, on.top);
        if (wide > 0.5 && high > 0.5 && name(a) < name(b)) found.push(name(a) + " over " + name(b));
    }
    const side = panel.getBoundingClientRect();
    for (const [each, box] of shown) if (!inPanel(each) && !panel.hidden)
        if (box.top < side.bottom - 0.5 && side.top + 0.5 < box.bottom
            && box.left < side.right - 0.5 && side.left + 0.5 < box.right)
            found.push(name(each) + " over the panel");
    return found;
}"""
"""What lies over another control, over the panel, or outside of the window."""


def share_of_map(page: Page) -> float:
    """The part of the window's height that the map has."""
    return float(
        page.evaluate("() => document.querySelector('canvas.map').clientHeight / innerHeight")
    )


@pytest.mark.parametrize("size", SIZES)
def test_controls_lie_beside_each_other(size: str, rooms: UiServer, visit: Visit) -> None:
    width, height = SIZES[size]
    page = visit(rooms, viewport={"width": width, "height": height})
    is_narrow = width <= 900
    panel = page.locator("#panel")
    expect(panel).to_be_visible(visible=not is_narrow)  # the map comes first where there is no room
    whole(page)
    assert share_of_map(page) > (0.5 if is_narrow else 0.6)
    assert page.evaluate(_COVERED) == []
    page.get_by_role("tab", name="Why").click()
    expect(panel).to_be_visible()
    answered(page)
    assert page.evaluate(_COVERED) == []
    assert share_of_map(page) > 0.3
    for tab in ("Compare", "Find", "Lost", "Correct"):
        page.get_by_role("tab", name=tab).click()
        answered(page)
        assert page.evaluate(_COVERED) == []
        assert page.evaluate("() => document.documentElement.scrollWidth <= innerWidth")


def test_a_tap_on_the_map_opens_the_panel_as_a_sheet(rooms: UiServer, visit: Visit) -> None:
    page = visit(rooms, viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True)
    expect(page.locator("#panel")).to_be_hidden()
    box = page.locator("canvas.map").bounding_box()
    assert box is not None
    page.touchscreen.tap(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    expect(page.locator(".thing")).to_be_visible()
    sheet, canvas = page.locator(".side").bounding_box(), page.locator("canvas.map").bounding_box()
    assert sheet is not None
    assert canvas is not None
    assert sheet["y"] >= canvas["y"] + canvas["height"] - 1
    page.get_by_role("button", name="Close the panel").click()
    expect(page.locator("#panel")).to_be_hidden()
