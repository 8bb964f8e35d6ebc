"""Objects of the Python interface in several threads at once, while the log grows."""

import random
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier
from typing import Any

import pytest
from mapfold import Map, Settings, Timeline, fold, open_log, relocalize

from eventsrc.log import GROUP_COMMIT, LogReader, LogWriter
from tests.property.test_timeline_cache import kept_early
from tests.support.evidence_drives import EVIDENCE
from tests.support.histories import whole
from tests.support.logs import append_command, append_raw, bridge, name_place, walk, write_log
from tests.support.thorough import mostly_slow, rounds

THREADS = 5
CLASSIC = Settings(eps_m=0.8, min_samples=3)
ROOMS = Settings(places="rooms")


@pytest.fixture(autouse=True)
def quick_switches() -> Iterator[None]:
    """Threads take turns a hundred times as often as usual."""
    usual = sys.getswitchinterval()
    sys.setswitchinterval(usual / 100)
    yield
    sys.setswitchinterval(usual)


def at_once(*works: Callable[[], Any]) -> list[Any]:
    """The results of some work, each in a thread of its own; they begin together."""
    together = Barrier(len(works))

    def begin(work: Callable[[], Any]) -> Any:
        together.wait()
        return work()

    with ThreadPoolExecutor(len(works)) as pool:
        return list(pool.map(begin, works))


def documents() -> Sequence[dict[str, Any]]:
    return [*walk(40), *bridge()]


@pytest.mark.parametrize("rules", mostly_slow([CLASSIC, ROOMS, EVIDENCE]))
@pytest.mark.parametrize("kept", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_one_timeline_asked_by_threads_while_its_log_grows(
    tmp_path: Path, rules: Settings, kept: bool
) -> None:
    log, recorded = tmp_path / "log", documents()
    write_log(log, recorded[:20])
    append_command(log, name_place(2, "hall"))
    timeline = Timeline(log, rules, cache=kept)

    def grow() -> None:
        for first in range(20, len(recorded), 4):
            write_log(log, recorded[first : first + 4])
            timeline.refresh()

    def ask(seed: int) -> dict[int, tuple[Any, ...]]:
        rng = random.Random(seed)
        found = {}
        for _ in range(rounds(30, 5)):
            end = rng.randrange(timeline.end + 1)
            shown = timeline.at(end)
            early = rng.randrange(end + 1)
            asked = [
                lambda: shown.digest,  # noqa: B023
                lambda: timeline.merges(end),  # noqa: B023
                lambda: timeline.diff(early, end),  # noqa: B023
            ]
            rng.shuffle(asked)
            for each in asked:
                each()
            found[end] = shown.digest, shown.state, timeline.merges(end)
            found |= {early: (timeline.at(early).digest, None, timeline.merges(early))}
        return found

    with kept_early(), timeline:
        answers = at_once(grow, *((lambda s=seed: ask(s)) for seed in range(THREADS)))[1:]
        last = timeline.at("end").digest
    assert last == fold(log, settings=rules).digest
    with Timeline(log, rules, cache=False) as alone:
        for found in answers:
            for end, (digest, state, merges) in found.items():
                assert digest == fold(log, at=end, settings=rules).digest
                assert state is None or state == alone.at(end).state
                assert merges == alone.merges(end)


def test_one_map_looked_at_by_threads(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log", documents())
    with Timeline(log, EVIDENCE, cache=False) as timeline:
        expected = whole(timeline.at(50).view)
        for _ in range(rounds(20, 2)):
            shown: Map = timeline.at(50)
            assert at_once(*[lambda: whole(shown.view)] * THREADS) == [expected] * THREADS  # noqa: B023


def test_one_map_asked_where_by_threads(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log", documents())
    question = [{"class": "☕ 🤖"}, {"class": "baker's rack"}]
    expected = relocalize(fold(log, settings=CLASSIC), question).document()
    house = fold(log, settings=CLASSIC)
    asked = at_once(*[lambda: relocalize(house, question).document()] * THREADS)
    assert asked == [expected] * THREADS


def test_one_reader_used_by_threads_while_its_log_grows(tmp_path: Path) -> None:
    log, count = tmp_path / "log", rounds(3_000, 250)
    append_raw(log, b"0")

    def grow() -> None:
        with LogWriter(log, fsync=GROUP_COMMIT, rotate_events=20) as writer:
            for number in range(1, count):
                writer.append("tb/raw", b"%d" % number)
                if number % 7 == 0:
                    writer.sync()

    with open_log(log) as reader:

        def follow(seed: int) -> int:
            rng, known = random.Random(seed), 0
            while known < count:
                assert reader.refresh() >= known
                start, known = rng.randrange(known + 1), reader.next_offset
                read = [(event.offset, event.payload) for event in reader.read(start, known)]
                assert read == [(at, b"%d" % at) for at in range(start, known)]
            return known

        threads = ((lambda s=seed: follow(s)) for seed in range(THREADS))
        assert at_once(grow, *threads)[1:] == [count] * THREADS
        assert [event.offset for event in reader.read()] == list(range(count))
    with LogReader(log) as fresh:
        assert [each.base for each in fresh.segments] == [each.base for each in reader.segments]
