"""Calls made by several processes: results, their order and errors are those of one process."""

import os
import signal
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from typing import Any

import pytest

from eventsrc.base.worker_process import ProcessGone
from projections.localize.evaluate import parallel
from projections.localize.evaluate.parallel import call_all
from tests.support.thorough import mostly_slow

COUNT = 400
POWERS = [partial(pow, 3, number) for number in range(COUNT)]
RESULTS = [3**number for number in range(COUNT)]


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The processes that were started; each has answered its first call before the others are
    shared out."""
    found: list[Any] = []
    start = parallel._start

    def ready(calls: Sequence[Any], count: int, stack: ExitStack) -> list[Any]:
        processes = start(calls, count, stack)
        for number, process in enumerate(processes):
            process.give(number)
            assert process.has_answer(60)
        found.extend(processes)
        return processes

    monkeypatch.setattr(parallel, "_start", ready)
    return found


def asked(calls: Sequence[Any], workers: int, said: list[str] | None = None) -> list[Any]:
    note = None if said is None else said.append
    return call_all(calls, workers, "asking", "questions", note)


@pytest.mark.slow
@pytest.mark.seconds
@pytest.mark.parametrize("workers", mostly_slow([2, 1, 3]))
def test_results_are_in_the_order_of_the_calls_whichever_process_makes_them(
    started: list[Any], workers: int
) -> None:
    said: list[str] = []
    calls = [call for power in POWERS for call in (power, os.getpid)]
    results = asked(calls, workers, said)
    assert results[::2] == RESULTS
    # Each has answered a call before (see ``started``); on a busy machine one may get no further.
    assert set(results[1::2]) <= {os.getpid(), *(each._process.pid for each in started)}
    assert len(started) == workers
    assert said == []


@pytest.mark.slow
@pytest.mark.seconds
@pytest.mark.parametrize(("killed", "after"), mostly_slow([(1, 20), (2, 1), (2, 50), (1, 0)]))
def test_a_killed_process_costs_nothing_but_time(
    started: list[Any], killed: int, after: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    take = parallel._SharingProcess.take_answers

    def killing(self: Any, results: dict[int, Any]) -> None:
        take(self, results)
        if len(results) > after:
            for process in started[:killed]:
                process._process.kill()
                process._process.wait()

    monkeypatch.setattr(parallel._SharingProcess, "take_answers", killing)
    said: list[str] = []
    assert asked(POWERS, 2, said) == RESULTS
    (line,) = said
    assert line == (
        f"{killed} of the 2 processes that asked died, perhaps for lack of memory; what they had"
        " not answered was asked again"
    )


@pytest.mark.slow
@pytest.mark.seconds
@pytest.mark.parametrize("workers", [0, 1, pytest.param(2, marks=pytest.mark.slow)])
def test_the_error_of_a_call_is_raised_and_ends_the_processes(
    started: list[Any], workers: int
) -> None:
    calls = [*POWERS[:9], partial(int, "nine"), *POWERS[10:]]
    with pytest.raises(ValueError, match="'nine'"):
        asked(calls, workers)
    assert len(started) == workers
    assert all(process._process.returncode is not None for process in started)


@pytest.mark.parametrize(("calls", "workers"), [(0, 4), (1, 4), (99, 4), (400, 0)])
def test_no_process_is_started_for_few_calls(started: list[Any], calls: int, workers: int) -> None:
    assert asked(POWERS[:calls], workers) == RESULTS[:calls]
    assert started == []


@pytest.mark.parametrize("error", [ProcessGone, OSError])
def test_where_no_process_can_be_started_this_one_makes_all_calls(
    error: type[Exception], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(memory: int) -> None:
        raise error

    monkeypatch.setattr(parallel, "_SharingProcess", {int: refuse, parallel.T: refuse})
    assert asked(POWERS, 2) == RESULTS


@pytest.mark.seconds
def test_a_process_that_ends_at_once_is_not_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel, "_make_calls", sys.exit)
    assert asked(POWERS, 2) == RESULTS


@pytest.mark.seconds
def test_a_process_that_stands_still_is_not_waited_for(
    started: list[Any], monkeypatch: Any
) -> None:
    """At the end this process makes the calls that another was given and has not answered."""
    take = parallel._SharingProcess.take_answers

    def stopping(self: Any, results: dict[int, Any]) -> None:
        if not results:
            os.kill(self._process.pid, signal.SIGSTOP)
        take(self, results)

    monkeypatch.setattr(parallel._SharingProcess, "take_answers", stopping)
    said: list[str] = []
    assert asked(POWERS, 1, said) == RESULTS
    assert len(started[0].given) == parallel._AHEAD
    assert said == []
