"""The service behind the page without HTTP: folds given up, and how many maps are kept."""

import asyncio
import contextlib
import json
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from starlette.datastructures import QueryParams
from starlette.requests import Request
from starlette.types import Message

from eventsrc.base.errors import LogError
from eventsrc.envelope.model import Offset
from eventsrc.log import LogReader
from projections.fold.corrections import Corrections
from projections.fold.settings import Settings
from projections.history.rule_folds import Rules, fold_all
from projections.map.digest import map_digest
from projections.map.fold import fold_log
from projections.surfaces.ui.app import create_app
from projections.surfaces.ui.comparisons import whatif_answer
from projections.surfaces.ui.editor import Edit, Editor
from projections.surfaces.ui.live_watch import LiveWatch
from projections.surfaces.ui.log_map import MOST_ALTERNATIVES, LogMap, Opened
from projections.surfaces.ui.question_threads import GivenUp, UiService
from tests.support.event_loops import run_apart
from tests.support.logs import walk, write_log

WAIT_S = 60.0


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(tmp_path_factory.mktemp("service") / "log", walk(1300, seed=5, detections=1))


@pytest.fixture
def service(log: Path) -> Iterator[UiService]:
    with UiService(Opened(log, lambda corrections: corrections.settings or Settings())) as opened:
        yield opened


def digest(shown: LogMap, _: float) -> str:
    return map_digest(shown.timeline.at())


def folded(log: Path, rules: Settings) -> str:
    with LogReader(log) as reader:
        return map_digest(fold_log(reader, rules)[1])


def test_a_fold_without_a_waiting_client_is_given_up_and_continued_later(
    log: Path, service: UiService
) -> None:
    calls = iter([True, True, False])
    with pytest.raises(GivenUp):
        service.ask(["eps_m=0.8"], digest, lambda: next(calls)).result(WAIT_S)
    assert next(calls, None) is None  # asked at the start and after each 500 events
    progress: list[bool] = []
    found = service.ask(["eps_m=0.8"], digest, lambda: not progress.append(True)).result(WAIT_S)
    assert found == folded(log, Settings(eps_m=0.8))
    whole: list[bool] = []
    service.ask(["eps_m=0.9"], digest, lambda: not whole.append(True)).result(WAIT_S)
    assert len(progress) < len(whole)


def test_the_end_gives_up_the_fold_under_way_and_all_questions(
    log: Path, service: UiService
) -> None:
    service.ask([], digest).result(WAIT_S)

    def ending() -> bool:
        service.end()
        return True

    for sets, wanted in (
        (["eps_m=0.8"], ending),
        (["eps_m=0.9"], lambda: True),
        ([], lambda: True),
    ):
        with pytest.raises(GivenUp, match="ends"):
            service.ask(sets, digest, wanted).result(WAIT_S)


@pytest.mark.parametrize("answer", ["whatif", "relocalize", "edit"])
def test_long_answers_are_given_up_while_they_fold(
    log: Path, service: UiService, answer: str
) -> None:
    """Each takes a fold at least; ``wanted`` is asked at its beginning and while it folds."""
    query = QueryParams("eps_m=0.8")
    question = json.dumps({"crops": [{"class": "baker's rack"}]}).encode()
    editor = Editor(service.opened, service.log_id, contextlib.nullcontext, "somebody")  # type: ignore[arg-type]
    edit = Edit(kind="forget-run", arguments=["run-a"])
    work = {
        "whatif": lambda end, go_on: whatif_answer(service.opened, end, query, go_on),
        "relocalize": lambda end, go_on: service.localizer.answer(end, query, question, go_on),
        "edit": lambda end, go_on: editor.answer(end, edit, go_on),
    }[answer]
    asked: list[bool] = []

    def wanted() -> bool:
        asked.append(True)
        return len(asked) < 3

    with pytest.raises(GivenUp, match="no client waits"):
        service.ask_apart(work, wanted).result(WAIT_S)
    assert len(asked) == 3
    assert service.ask_apart(work).result(WAIT_S)["through"] == 1300


@pytest.mark.slow
def test_processes_of_a_what_if_stop_when_it_is_given_up(log: Path) -> None:
    def progress(_folded: int, _events: int) -> None:
        raise GivenUp

    rules = [Rules(Settings(eps_m=eps)) for eps in (0.5, 1.0)]
    with pytest.raises(GivenUp):
        fold_all(log, rules, Offset(1300), processes=2, progress=progress)


def test_another_log_in_the_same_place_is_not_folded(tmp_path: Path) -> None:
    here = write_log(tmp_path / "log", walk(20, seed=6))
    with UiService(Opened(here, lambda _: Settings())) as service:
        assert service.ask(["eps_m=0.8"], lambda shown, _: shown.through).result(WAIT_S) == 20
        shutil.rmtree(here)
        write_log(here, walk(20, seed=7))
        with pytest.raises(LogError, match="another log"):
            service.ask(["eps_m=0.9"], digest).result(WAIT_S)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_an_unexpected_error_is_printed_and_raised(tmp_path: Path) -> None:
    """It ends the following of the log, not the answers."""
    log = write_log(tmp_path / "log", walk(5))
    failing: list[bool] = []

    def settings(_: Corrections) -> Settings:
        if failing:
            raise ZeroDivisionError("a fault of the program")
        return Settings()

    with UiService(Opened(log, settings)) as service:
        assert service.refresh().result(WAIT_S) is False
        failing.append(True)
        write_log(log, walk(3, seed=9, first=5))
        with LiveWatch(service) as watch:
            watch._threads[0].join(WAIT_S)
            assert not watch._threads[0].is_alive()
            (problem,) = watch.document()["problems"]
        assert "a fault of the program" in problem
        assert "stderr" in problem


def test_the_state_names_the_log(log: Path, tmp_path: Path) -> None:
    """Else a page whose server now shows another log would add that one's rows to its own."""
    other = write_log(tmp_path / "log", walk(20, seed=6))
    keys = set()
    for each in (log, other):
        with UiService(Opened(each, lambda _: Settings())) as service:
            keys.add(service.ask([], lambda shown, _: shown.key).result(WAIT_S))
    assert len(keys) == 2


def test_work_that_has_not_begun_is_dropped(service: UiService) -> None:
    done: list[str] = []
    first = service.ask(["eps_m=0.7"], digest)
    second = service.ask(["eps_m=0.6"], lambda shown, _: done.append(shown.key))
    assert second.cancel()
    first.result(WAIT_S)
    service.ask(["eps_m=0.7"], digest).result(WAIT_S)
    assert done == []


def test_few_maps_are_kept(log: Path, service: UiService) -> None:
    seconds: dict[str, float] = {}

    def kept(text: str) -> int:
        def work(shown: LogMap, took: float) -> int:
            seconds[text] = took
            return id(shown)

        return service.ask([text], work).result(WAIT_S)

    texts = [f"eps_m={0.5 + 0.1 * number:.1f}" for number in range(MOST_ALTERNATIVES + 1)]
    first = [kept(text) for text in texts[:MOST_ALTERNATIVES]]
    assert [kept(text) for text in texts[:MOST_ALTERNATIVES]] == first
    kept(texts[-1])  # the one that was asked first goes
    assert kept(texts[1]) == first[1]
    held = service._alternatives
    assert len(held) == MOST_ALTERNATIVES
    assert all(len(shown.timeline._histories) == 1 for shown in held.values())
    assert service.ask([texts[0]], digest).result(WAIT_S) == folded(log, Settings(eps_m=0.5))


def test_other_settings_are_folded_as_far_as_the_log_is(log: Path, tmp_path: Path) -> None:
    grown = write_log(tmp_path / "log", walk(20, seed=6))
    with UiService(Opened(grown, lambda _: Settings())) as service:
        assert service.ask(["eps_m=0.8"], lambda shown, _: shown.through).result(WAIT_S) == 20
        write_log(grown, walk(10, seed=6, first=20))
        assert service.ask(["eps_m=0.8"], lambda shown, _: shown.through).result(WAIT_S) == 20
        assert service.refresh().result(WAIT_S) is True
        assert service.ask(["eps_m=0.8"], lambda shown, _: shown.through).result(WAIT_S) == 30
        assert service.refresh().result(WAIT_S) is False
        assert service.ask(["eps_m=0.8"], digest).result(WAIT_S) == folded(
            grown, Settings(eps_m=0.8)
        )


async def _stays() -> Message:
    """A client that does not leave."""
    await asyncio.Event().wait()
    raise AssertionError


def test_commands_are_listed_while_the_map_and_a_fold_are_busy(
    service: UiService, log: Path
) -> None:
    """And the map answers while they are listed."""
    held = threading.Event()
    with LiveWatch(service) as watch:
        app = create_app(service, watch)
    service.ask([], digest).result(WAIT_S)
    busy = [service.ask([], lambda *_: held.wait(WAIT_S))]
    busy += [service.ask_apart(lambda *_: held.wait(WAIT_S))]
    try:
        (route,) = (each for each in app.routes if getattr(each, "path", "") == "/api/corrections")
        request = Request({"type": "http", "query_string": b"", "headers": []}, _stays)
        answer = run_apart(asyncio.wait_for(route.endpoint(request), WAIT_S))
        assert json.loads(answer.body)["corrections"] == []
        listing = service.ask_apart(lambda *_: held.wait(WAIT_S), folds=False)
    finally:
        held.set()
    assert [each.result(WAIT_S) for each in [*busy, listing]] == [True] * 3
