"""Time of the first map and from moving the slider to the painted map, in a real browser without a
graphics card.

``scripts/test_ui --bench`` runs it. Makes a log of a robot that drives about a house for each
number of keyframes, opens its page with ``?bench`` once the log is folded, and moves W to moments
all over the log. The limits are on processor time, which other work on the machine changes little:
of the page and the server until the first map, and of the page's thread for a move (95th
percentile). The clock's times are printed beside it.
"""

import argparse
import random
import statistics
import sys
import tempfile
from pathlib import Path

from playwright.sync_api import Browser, CDPSession, Page

from eventsrc.log import NEVER, LogWriter
from scripts.programs.bench.timetravel import payloads
from tests.support.commands import Commands, cpu_seconds
from tests.support.ui_page import UiServer, showing
from tests.ui.browser import answered, browser

MOVE_LIMIT_MS, FIRST_LIMIT_S = 60.0, 1.0
DETECTIONS, DIM = 3, 16
COMPILING = 5
"""Moves before those that count, in which the browser compiles the script."""
SETTINGS = ("--set", "eps_m=0.75", "--set", "min_samples=8")


def write(path: Path, keyframes: int) -> Path:
    """A log of so many keyframes, with three detections in each."""
    with LogWriter(path, fsync=NEVER) as writer:
        for stamp_ns, payload in payloads(keyframes, DETECTIONS, DIM):
            writer.append("tb/detections", payload, logged_ns=stamp_ns)
    return path


def measure(folder: Path, keyframes: int, moves: int) -> bool:
    """Print the times; whether the limits are kept."""
    log = write(folder / f"log-{keyframes}", keyframes)
    mapfold = Commands.in_folder(folder)
    with showing(mapfold, log, *SETTINGS) as server, browser(folder / "home") as chromium:
        _opened(chromium, server)  # folds the log
        *_, (page, first_s, clock_s) = sorted(
            (_opened(chromium, server) for _ in range(3)), key=lambda each: -each[1]
        )
        thread = page.context.new_cdp_session(page)
        thread.send("Performance.enable", {"timeDomain": "threadTicks"})
        of_clock, of_thread = list[float](), list[float]()
        draw = random.Random(1)
        for move in range(moves + COMPILING):
            at, before = draw.randrange(keyframes), _seconds(thread, "TaskDuration")
            taken_ms = page.evaluate("at => window.mapfoldBench(at)", at)
            if move >= COMPILING:
                of_clock.append(taken_ms)
                of_thread.append(1e3 * (_seconds(thread, "TaskDuration") - before))
    p95 = _p95(of_thread)
    print(
        f"{keyframes:,} keyframes: first map {first_s:.2f} s of processor time of page and server"
        f" (limit {FIRST_LIMIT_S} s), {clock_s:.2f} s by the clock"
    )
    print(
        f"{keyframes:,} keyframes, {moves} moves: {statistics.median(of_thread):.0f} ms of"
        f" processor time, p95 {p95:.0f} ms (limit {MOVE_LIMIT_MS:.0f} ms), most"
        f" {max(of_thread):.0f} ms; {statistics.median(of_clock):.0f} ms by the clock,"
        f" p95 {_p95(of_clock):.0f} ms"
    )
    return p95 <= MOVE_LIMIT_MS and first_s <= FIRST_LIMIT_S


def _opened(chromium: Browser, server: UiServer) -> tuple[Page, float, float]:
    """The page with its map, and the seconds until then: of processor time, and by the clock."""
    began = cpu_seconds(server.program.pid)
    page = chromium.new_page(viewport={"width": 1280, "height": 720})
    page.set_default_timeout(600_000)
    page.goto(f"http://127.0.0.1:{server.port}/?bench")
    page.wait_for_selector("html[data-painted]")
    clock_s = float(page.locator("html").get_attribute("data-painted") or "nan") / 1e3
    session = page.context.new_cdp_session(page)
    session.send("Performance.enable")
    used = _seconds(session, "ProcessTime") + cpu_seconds(server.program.pid) - began
    answered(page)  # the server has answered this page before the next one is opened
    return page, used, clock_s


def _seconds(session: CDPSession, name: str) -> float:
    metrics = session.send("Performance.getMetrics")["metrics"]
    return float(next(each["value"] for each in metrics if each["name"] == name))


def _p95(values: list[float]) -> float:
    return statistics.quantiles(values, n=20)[-1]


def main() -> int:
    """Measure, print, and fail where a limit is not kept."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--keyframes", type=int, nargs="+", default=[10_000, 100_000])
    parser.add_argument("--moves", type=int, default=100)
    asked = parser.parse_args()
    kept = True
    for keyframes in asked.keyframes:
        with tempfile.TemporaryDirectory() as folder:
            kept = measure(Path(folder), keyframes, asked.moves) and kept
    return 0 if kept else 1


if __name__ == "__main__":
    sys.exit(main())
