"""Time on the timeline: idle time is folded, runs are lanes, the clock is of what is pointed at."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from eventsrc.envelope.commands import Anchor, NamePlace, encode_command
from eventsrc.envelope.system_events import COMMAND_KEY
from eventsrc.log import NEVER, LogWriter
from tests.support.commands import Commands
from tests.support.envelopes import envelope
from tests.support.logs import write_log
from tests.support.ui_page import UiServer, showing
from tests.ui.conftest import Visit
from tests.ui.test_moments import go, moment

MARCH, NOVEMBER = 1_774_357_200, 1_795_000_000  # seconds
LONG = 400


@pytest.fixture(scope="module")
def march(mapfold: Commands, tmp_path_factory: pytest.TempPathFactory) -> Iterator[UiServer]:
    """Two robots that drove at the same time, one after the other in the log, and a third run the
    day after; a correction of today."""
    begins = {"ann": 0, "bob": 100, "ann-again": 90_000}
    documents = [
        envelope(k, x=0.05 * k, y=4.0 * lane, run_id=run, timestamp=float(MARCH + begin + k))
        for lane, (run, begin) in enumerate(begins.items())
        for k in range(LONG)
    ]
    log = write_log(tmp_path_factory.mktemp("march") / "log", documents)
    with LogWriter(log, fsync=NEVER) as writer:
        named = NamePlace(
            command_id="c1",
            issued_by="ann",
            reason="",
            place=Anchor(run_id="ann", keyframe_id=1),
            name="hall",
        )
        writer.append(COMMAND_KEY, encode_command(named), logged_ns=NOVEMBER * 10**9)
    with showing(mapfold, log) as server:
        yield server


def head(page: Page) -> float:
    """Where the moment is along the track, as a share of its width."""
    track = page.locator(".track").bounding_box()
    line = page.locator(".track .head").bounding_box()
    assert track is not None
    assert line is not None
    return (line["x"] + line["width"] / 2 - track["x"]) / track["width"]


def by_time(page: Page) -> None:
    page.get_by_text("Time", exact=True).click()


def test_a_correction_of_today_leaves_the_runs_their_width(
    march: UiServer, visit: Visit, pictures: Path
) -> None:
    page = visit(march, "#panel=none")
    by_time(page)
    places = []
    for offset in (1, LONG, 2 * LONG, 2 * LONG + 1, 3 * LONG, 3 * LONG + 1):
        go(page, offset)
        expect(page.get_by_role("slider", name="Moment")).to_have_attribute(
            "aria-valuenow", str(offset)
        )
        places.append(head(page))
    assert places == sorted(places)
    begin, first, second, third, end, correction = places
    assert second - begin > 0.45
    assert end - third > 0.35
    assert 0.005 < correction - end < 0.05
    assert first < second
    track = page.locator(".track").bounding_box()
    assert track is not None
    middle = track["x"] + track["width"] * (second + third) / 2
    page.mouse.move(middle, track["y"] + track["height"] / 2)
    expect(page.locator(".tip")).to_have_text("25 hours without an event")
    page.screenshot(path=pictures / "time-axis.png")


def test_each_run_is_a_lane_and_the_clock_is_that_of_the_event_pointed_at(
    march: UiServer, visit: Visit
) -> None:
    page = visit(march, "#at=10&panel=none&clock=time")
    clock = page.locator(".moment .time")
    expect(clock).to_have_text("2026-03-24 13:00:09")
    go(page, 300)
    track = page.locator(".track").bounding_box()
    assert track is not None
    x = track["x"] + track["width"] * head(page)
    said = []
    for lane in range(3):
        page.mouse.move(x, track["y"] + 32 + 50 * (lane + 0.4) / 3)
        expect(clock).to_contain_text("event")
        text = clock.inner_text()
        said.append((int(re.findall(r"event (\d+)", text)[0]), text[-8:]))
    assert abs(said[0][0] - 299) <= 1
    assert abs(said[1][0] - (LONG + 199)) <= 1
    assert said[2] == said[1]  # the third run did not drive then: all events until then
    assert said[0][1] == said[1][1]
    page.mouse.down()
    page.mouse.up()
    assert moment(page) == said[2][0] + 1
    page.mouse.click(x, track["y"] + 32 + 50 * 0.4 / 3)
    assert moment(page) == said[0][0] + 1
    page.mouse.move(300, 200)
    expect(clock).to_have_text(f"2026-03-24 {said[0][1]}")
