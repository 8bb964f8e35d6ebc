"""What goes wrong beside the page: answers that are lost, a server that refuses, a page that is
hidden, names and ids that few logs have."""

import json
from contextlib import ExitStack
from pathlib import Path

from playwright.sync_api import Page, Route, expect

from projections.surfaces.ui.live_watch import MOST_STREAMS
from tests.support.commands import Commands
from tests.support.envelopes import detection, envelope
from tests.support.logs import write_log
from tests.support.ui_page import UiServer, showing
from tests.ui.browser import answered
from tests.ui.conftest import Visit

BUSY = json.dumps({"error": {"kind": "too_much", "message": "too many questions are waiting"}})


def refuse(route: Route) -> None:
    route.fulfill(status=503, content_type="application/json", body=BUSY)


def test_a_refusal_while_the_log_grows_is_forgotten_when_it_is_over(
    mapfold: Commands, visit: Visit, tmp_path: Path
) -> None:
    log = write_log(tmp_path / "log", [envelope(k, x=0.1 * k) for k in range(1, 9)])
    with showing(mapfold, log) as server:
        page = visit(server)
        page.route("**/api/history?*", refuse)
        write_log(log, [envelope(9, x=0.9)])
        expect(page.get_by_role("alert")).to_contain_text("too many questions")
        page.unroute("**/api/history?*")
        write_log(log, [envelope(10, x=1.0)])
        expect(page.locator(".facts")).to_contain_text("10 keyframes")
        expect(page.get_by_role("alert")).to_have_count(0)


def test_a_refusal_at_first_is_asked_again_and_the_link_is_kept(
    sample: UiServer, visit: Visit
) -> None:
    page = visit(sample, "#at=300&select=place:sim-7-a_p0", wait=False)
    page.route("**/api/history", refuse)
    page.reload()
    expect(page.get_by_role("alert")).to_contain_text("too many questions")
    page.wait_for_timeout(500)  # longer than the address waits to be written
    page.unroute("**/api/history")
    expect(page.locator(".facts")).to_contain_text("300 keyframes")
    expect(page.locator(".thing")).to_contain_text("p0")
    assert "at=300" in page.url


def test_a_page_too_many_says_so_and_shows_its_map(
    mapfold: Commands, visit: Visit, tmp_path: Path
) -> None:
    log = write_log(tmp_path / "log", [envelope(k, x=0.1 * k) for k in range(1, 9)])
    with showing(mapfold, log) as server, ExitStack() as stack:
        for _ in range(MOST_STREAMS):
            next(stack.enter_context(server.live()))
        page = visit(server)
        expect(page.get_by_role("alert")).to_contain_text(f"{MOST_STREAMS} pages follow")
        expect(page.locator(".facts")).to_contain_text("8 keyframes")
        stack.pop_all().close()
        expect(page.get_by_role("alert")).to_have_count(0)


def hide(page: Page, *, hidden: bool) -> None:
    page.evaluate(
        "value => { Object.defineProperty(document, 'hidden', {value, configurable: true});"
        " document.dispatchEvent(new Event('visibilitychange')); }",
        hidden,
    )


def test_a_hidden_page_holds_no_connection_and_catches_up(
    mapfold: Commands, visit: Visit, tmp_path: Path
) -> None:
    log = write_log(tmp_path / "log", [envelope(k, x=0.1 * k) for k in range(1, 9)])
    with showing(mapfold, log) as server:
        with ExitStack() as stack:
            page = visit(server)
            expect(page.locator(".facts")).to_contain_text("8 keyframes")
            hide(page, hidden=True)
            for _ in range(MOST_STREAMS):  # the page's stream is not among them any more
                next(stack.enter_context(server.live()))
            write_log(log, [envelope(9, x=0.9)])
        expect(page.locator(".facts")).to_contain_text("8 keyframes")
        hide(page, hidden=False)
        expect(page.locator(".facts")).to_contain_text("9 keyframes")


def test_a_correction_whose_answer_is_lost_is_recorded_once(
    mapfold: Commands, visit: Visit, tmp_path: Path
) -> None:
    log = write_log(tmp_path / "log", [envelope(k, x=0.1 * k) for k in range(1, 9)])
    with showing(mapfold, log, "--allow-edits") as server:
        page = visit(server, "#panel=correct")
        page.get_by_label("Place", exact=True).fill("run-a_p0")
        page.get_by_label("Name", exact=True).fill("kitchen")

        def lose(route: Route) -> None:
            route.fetch()  # the server records it
            route.abort()

        page.route("**/api/edit", lose)
        page.get_by_role("button", name="Record it").click()
        expect(page.locator("form [role=alert]")).to_contain_text("does not answer")
        page.unroute("**/api/edit")
        page.get_by_role("button", name="Record it").click()
        expect(page.locator(".corrections > li")).to_have_count(1)
        expect(page.get_by_role("button", name="Preview")).to_be_visible()
        assert len(server.api("corrections")["corrections"]) == 1


def test_the_marks_of_a_found_event_come_back_with_its_panel(
    sample: UiServer, visit: Visit
) -> None:
    page = visit(sample, "#at=100&panel=find")
    marks = "() => document.querySelector('canvas.marks').toDataURL()"
    answered(page)
    without = page.evaluate(marks)
    page.get_by_label("Condition over the map").fill("place_count() == 5")
    page.get_by_label("every turn").check()
    page.get_by_role("button", name="Find", exact=True).click()
    expect(page.locator(".steps > li").first).to_be_visible()
    page.wait_for_function(f"before => ({marks})() !== before", arg=without)
    answered(page)
    found = page.evaluate(marks)
    page.get_by_role("tab", name="Why").click()
    page.wait_for_function(f"before => ({marks})() === before", arg=without)
    page.get_by_role("tab", name="Find").click()
    page.wait_for_function(f"before => ({marks})() === before", arg=found)


def test_ids_of_64_bits_are_exact(mapfold: Commands, visit: Visit, tmp_path: Path) -> None:
    """A robot that numbers its keyframes by nanoseconds."""
    first = 1_760_000_000_000_000_123
    documents = [
        envelope(first + k, 0.1 * k, timestamp=1e9 + k, detections=[detection("cup", [1.0, 0.0])])
        for k in range(9)
    ]
    with showing(mapfold, write_log(tmp_path / "log", documents)) as server:
        page = visit(server)
        page.get_by_label("Search places").fill(f"run-a:{first + 4}")
        page.get_by_role("option").first.click()
        expect(page.locator(".thing")).to_contain_text(f"run-a:{first + 4}")
        expect(page.locator(".answer .summary")).to_contain_text("in p0")
        page.get_by_role("tab", name="Lost").click()
        page.get_by_role("button", name="Where is it?").click()
        expect(page.locator(".answer")).to_contain_text("true pose")


def test_a_question_that_is_too_long_is_told_before_it_is_sent(
    sample: UiServer, visit: Visit, tmp_path: Path
) -> None:
    file = tmp_path / "question.json"
    file.write_text(json.dumps({"crops": [{"class": "x" * 1_000_000}]}))
    page = visit(sample, "#panel=lost")
    page.locator("input[type=file]").set_input_files(file)
    expect(page.locator("#panel [role=alert]")).to_contain_text("at most 1,000,000")


def test_menus_are_walked_with_the_arrow_keys(sample: UiServer, visit: Visit) -> None:
    page = visit(sample, "#at=100")
    page.get_by_role("button", name="Take away").focus()
    page.keyboard.press("Enter")
    items = page.get_by_role("menuitem")
    expect(items.first).to_be_focused()
    page.keyboard.press("ArrowDown")
    expect(items.nth(1)).to_be_focused()
    page.keyboard.press("ArrowUp")
    page.keyboard.press("ArrowUp")
    expect(items.last).to_be_focused()
    page.keyboard.press("Escape")
    expect(items).to_have_count(0)
    expect(page.get_by_role("button", name="Take away")).to_be_focused()


def test_a_browser_that_keeps_nothing_shows_the_page(sample: UiServer, visit: Visit) -> None:
    page = visit(sample, wait=False)
    page.add_init_script(
        "for (const area of ['localStorage', 'sessionStorage'])"
        " Object.defineProperty(window, area, {get() { throw new DOMException('no') }})"
    )
    page.reload()
    expect(page.locator(".facts")).to_contain_text("445 keyframes")
    page.keyboard.press("t")


def test_a_restarted_server_with_another_log_shows_that_one(
    mapfold: Commands, visit: Visit, tmp_path: Path
) -> None:
    """At the same port, with the same settings, and longer than the one before."""
    logs = [
        write_log(tmp_path / name, [envelope(k, x=0.1 * k, run_id=name) for k in range(count)])
        for name, count in (("first", 6), ("second", 9))
    ]
    with showing(mapfold, logs[0]) as server:
        page = visit(server)
        expect(page.locator("table.rooms")).to_contain_text("p0")
        port = str(server.port)
    with showing(mapfold, logs[1], "--port", port):
        expect(page.locator("h1")).to_contain_text("second")
        expect(page.locator(".facts")).to_contain_text("9 keyframes")
        page.get_by_label("Search places").fill("first")
        expect(page.get_by_role("option").first).to_contain_text("no 'first'")


def test_two_pages_correct_one_log(mapfold: Commands, visit: Visit, tmp_path: Path) -> None:
    log = write_log(tmp_path / "log", [envelope(k, x=0.1 * k) for k in range(1, 9)])
    with showing(mapfold, log, "--allow-edits") as server:
        one, other = (visit(server, "#panel=correct") for _ in range(2))
        for page, name in ((one, "kitchen"), (other, "bathroom")):
            page.get_by_label("Place", exact=True).fill("run-a_p0")
            page.get_by_label("Name", exact=True).fill(name)
        one.get_by_role("button", name="Record it").click()
        expect(other.locator(".corrections > li")).to_have_count(1)
        expect(other.get_by_label("Name", exact=True)).to_have_value("bathroom")
        other.get_by_role("button", name="Record it").click()
        for page in (one, other):
            expect(page.locator(".corrections > li")).to_have_count(2)
        for page in (one, other):  # both propose to undo the same one; the second is told
            page.locator(".corrections > li").first.get_by_role("button", name="Undo").click()
            page.get_by_role("button", name="Preview").click()
            page.get_by_label("Reason").fill("it is no kitchen")
        with one.expect_response("**/api/edit"):
            one.get_by_role("button", name="Record it").click()
        other.get_by_role("button", name="Record it").click()
        expect(other.locator("form [role=alert]")).to_contain_text("undone")
        undone = [each["undone_by"] for each in server.api("corrections")["corrections"]]
        assert len(undone) == 3
        assert sum(each is not None for each in undone) == 1


def test_a_log_that_vanishes_and_comes_back(
    mapfold: Commands, visit: Visit, tmp_path: Path
) -> None:
    log = write_log(tmp_path / "log", [envelope(k, x=0.1 * k) for k in range(1, 9)])
    with showing(mapfold, log) as server:
        page = visit(server)
        away = log.rename(tmp_path / "away")
        expect(page.get_by_role("alert")).to_contain_text("is gone")
        page.keyboard.press("ArrowLeft")
        expect(page.locator(".facts")).to_contain_text("7 keyframes")
        page.keyboard.press("End")
        away.rename(log)
        expect(page.get_by_role("alert")).to_have_count(0)
        page.keyboard.press("l")
        write_log(log, [envelope(9, x=0.9)])
        expect(page.locator(".facts")).to_contain_text("9 keyframes")


def test_what_is_known_is_kept_when_a_late_answer_about_the_growing_log_comes(
    mapfold: Commands, visit: Visit, tmp_path: Path
) -> None:
    """The late one knows the command, the map shown does not: it must not be put in its place."""
    log = write_log(
        tmp_path / "log",
        [envelope(k, x=0.1 * k, run_id=run) for run in ("run-a", "run-b") for k in range(6)],
    )
    with showing(mapfold, log, "--allow-edits") as server:
        server.edit("forget-run", "run-a", reason="the robot was carried", dry_run=False)
        page = visit(server, "#panel=why")
        expect(page.locator(".facts")).to_contain_text("6 keyframes")
        held: list[Route] = []
        page.route("**/api/history?from=*", lambda route: held.append(route))
        write_log(log, [envelope(6, x=0.6, run_id="run-b")])
        for _ in range(300):
            page.wait_for_timeout(100)
            if held:
                break
        page.evaluate("location.hash = '#at=12&known=then&panel=why'")
        expect(page.locator(".facts")).to_contain_text("12 keyframes")
        with page.expect_response("**/api/history?from=*"):
            held[0].continue_()
        page.unroute("**/api/history?from=*")
        page.wait_for_timeout(1000)
        expect(page.locator(".facts")).to_contain_text("12 keyframes")
        page.keyboard.press("End")
        expect(page.locator(".facts")).to_contain_text("7 keyframes")
