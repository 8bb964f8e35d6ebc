"""Labels of the map cover neither each other nor the controls, from a phone to a large screen."""

from collections.abc import Iterator
from itertools import combinations
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from tests.support.commands import Commands
from tests.support.envelopes import detection, envelope
from tests.support.logs import write_log
from tests.support.shared_data import shared_run
from tests.support.ui_page import UiServer, showing
from tests.ui.browser import opened, pixels
from tests.ui.conftest import SIZES, Visit

ROOMS, VISITS = 120, 20
_RECORDED = """() => {
    const texts = window.drawnTexts = [];
    const on = CanvasRenderingContext2D.prototype;
    const [clear, write] = [on.fillRect, on.fillText];
    on.fillRect = function (...at) {
        if (this.canvas.dataset.side === "main") texts.length = 0;
        return clear.apply(this, at);
    };
    on.fillText = function (text, x, y) {
        const width = this.measureText(text).width;
        const height = Number(/(\\d+)px/.exec(this.font)[1]);
        const box = [text, x, y - height / 2, width, height];
        if (this.canvas.dataset.side === "main") texts.push(box);
        return write.apply(this, arguments);
    };
}"""
"""Records the texts on the map's canvas since it was last cleared, with their boxes."""

_CONTROLS = """() => {
    const map = document.querySelector("canvas.map").getBoundingClientRect();
    const found = document.querySelectorAll(".facts, .zoom, .scale, header button");
    return [...found].map(each => [each, each.getBoundingClientRect()])
        .filter(([each, box]) => box.width > 0)
        .map(([each, { x, y, width, height }]) =>
            [each.className, x - map.x, y - map.y, width, height]);
}"""

Boxed = tuple[str, float, float, float, float]


@pytest.fixture(scope="module")
def hospital(mapfold: Commands, tmp_path_factory: pytest.TempPathFactory) -> Iterator[UiServer]:
    """Rooms five metres apart, founded by two runs in turn, whose ids have a long common part."""
    log = tmp_path_factory.mktemp("hospital") / "log"
    documents = []
    for room in range(ROOMS):
        for visit in range(VISITS):
            number = room // 2 * VISITS + visit
            run = f"general-hospital-patrol-{'ab'[room % 2]}"
            x, y = 5.0 * (room % 8) + 0.1 * (visit % 5), 5.0 * (room // 8) + 0.1 * (visit // 5)
            seen = [detection(f"{run}_{number}", [1.0, 0.1 * (room % 7)])]
            documents.append(envelope(number, x=x, y=y, run_id=run, detections=seen))
    with showing(mapfold, write_log(log, documents)) as server:
        yield server


@pytest.fixture(scope="module")
def house_a(mapfold: Commands, tmp_path_factory: pytest.TempPathFactory) -> Iterator[UiServer]:
    folder = tmp_path_factory.mktemp("house-a")
    (folder / "house-a.jsonl").write_bytes(b"\n".join(shared_run("house-a")))
    mapfold("import", folder / "log", folder / "house-a.jsonl", "--preset", "full")
    with showing(mapfold, folder / "log") as server:
        yield server


def texts_of(page: Page) -> list[Boxed]:
    pixels(page)
    return [tuple(each) for each in page.evaluate("() => window.drawnTexts")]


def covers(one: Boxed, other: Boxed) -> bool:
    (_, x, y, width, height), (_, left, top, wide, high) = one, other
    return x < left + wide and left < x + width and y < top + high and top < y + height


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("log", ["rooms", "house_a", "hospital"])
def test_labels_cover_neither_each_other_nor_controls(
    log: str, size: str, visit: Visit, request: pytest.FixtureRequest, pictures: Path
) -> None:
    server: UiServer = request.getfixturevalue(log)
    width, height = SIZES[size]
    page = visit(server, wait=False, viewport={"width": width, "height": height})
    page.add_init_script(f"({_RECORDED})()")
    opened(page, page.url)
    for zoom in range(3):
        texts, controls = texts_of(page), [tuple(each) for each in page.evaluate(_CONTROLS)]
        page.screenshot(path=pictures / f"labels-{log}-{size}-{zoom}.png")
        assert len(controls) >= 5
        over = [pair for pair in combinations([*texts, *controls], 2) if covers(*pair)]
        assert over == []
        assert texts or zoom, "no label at all"
        page.get_by_role("button", name="Zoom in").click()
        page.get_by_role("button", name="Zoom in").click()


def test_far_off_places_have_names_without_what_all_ids_begin_with(
    hospital: UiServer, visit: Visit
) -> None:
    page = visit(hospital, wait=False, viewport={"width": 1280, "height": 720})
    page.add_init_script(f"({_RECORDED})()")
    opened(page, page.url)
    names = [text.strip("\u2068\u2069") for text, *_ in texts_of(page)]
    assert len(names) >= 10
    assert {name[:3] for name in names} <= {"a_p", "b_p"}
    page.get_by_role("button", name=f"all {ROOMS}").click()
    rows = page.locator("table.rooms tbody th button").all_inner_texts()
    assert set(names) <= {row.strip("\u2068\u2069") for row in rows}
    page.get_by_label("Search places").fill(names[0])
    expect(page.get_by_role("option").first).to_contain_text(names[0])
