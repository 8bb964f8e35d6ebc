"""The service behind the page without HTTP: folds given up, and how many maps are kept."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from eventsrc.log import LogReader
from projections.model.digest import map_digest
from projections.model.fold import fold_log
from projections.settings import Settings
from projections.ui.log_map import MOST_ALTERNATIVES, LogMap
from projections.ui.opened import Opened
from projections.ui.service import GivenUp, UiService
from tests.logs import walk, write_log

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


def test_a_fold_that_nobody_waits_for_is_given_up_and_continued_later(
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
