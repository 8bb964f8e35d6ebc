"""Calls in worker processes: outcomes, killed workers, errors, progress, no process left behind."""

import os
import signal
import sys
from contextlib import closing
from functools import partial
from pathlib import Path

import pytest

from eventsrc.base.worker_process import Called, ProcessGone, ProcessKilled, call_in_processes
from tests.support.worker_calls import (
    aborts,
    answers_unportably,
    double,
    fails,
    fails_unportably,
    killed,
    process_id,
    quits,
    wait,
)


@pytest.mark.seconds
def test_each_call_has_one_outcome_whichever_worker_is_killed(tmp_path: Path) -> None:
    times = [0, 1, 0, 3]
    calls = [partial(killed, tmp_path, number, each) for number, each in enumerate(times)]
    ended = sorted(call_in_processes(calls, 2, attempts=3), key=lambda each: each.number)
    assert ended[:3] == [Called(0, 0, None, 1), Called(1, 1, None, 2), Called(2, 2, None, 1)]
    assert (ended[3].result, ended[3].attempts) == (None, 3)
    assert isinstance(ended[3].error, ProcessKilled)
    # Beside a worker that was killed no other call was made again.
    assert [(tmp_path / str(n)).stat().st_size for n in range(4)] == [1, 2, 1, 3]


@pytest.mark.seconds
def test_progress_is_the_sum_of_what_calls_report() -> None:
    seen: list[int] = []
    ended = call_in_processes([partial(double, 5), partial(double, 7)], 1, seen.append)
    assert list(ended) == [Called(0, 10, None, 1), Called(1, 14, None, 1)]
    assert seen[-1] == 12


@pytest.mark.seconds
def test_an_error_is_the_outcome_of_its_call_alone() -> None:
    calls = [partial(fails, 3), fails_unportably, answers_unportably, quits, partial(double, 1)]
    errors = [(each.result, repr(each.error)) for each in call_in_processes(calls, 1)]
    assert errors == [
        (None, "ValueError('no 3')"),
        (None, "RuntimeError('Unportable: 1 and 2')"),
        (None, "TypeError(\"cannot pickle '_thread.lock' object\")"),
        (None, "RuntimeError('SystemExit: enough')"),
        (2, "None"),
    ]


@pytest.mark.seconds
def test_how_a_worker_died_is_in_the_error() -> None:
    died, made = call_in_processes([aborts, partial(double, 1)], 1)
    assert repr(died.error) == "ProcessGone('Aborted: heap: corrupted')"
    assert made.result == 2


@pytest.mark.seconds
def test_why_workers_cannot_start_is_in_the_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "path", [str(tmp_path)])
    (died,) = call_in_processes([partial(double, 1)], 1)
    assert repr(died.error) == (
        "ProcessGone(\"exit code 1: ModuleNotFoundError: No module named 'eventsrc'\")"
    )


@pytest.mark.seconds
def test_a_worker_killed_between_two_calls_costs_none_of_them_an_attempt() -> None:
    ended = call_in_processes([process_id] * 2, 1)
    first = next(ended).result
    assert first is not None
    os.kill(first, signal.SIGKILL)
    os.waitid(os.P_PID, first, os.WEXITED | os.WNOWAIT)
    (second,) = ended
    assert second.error is None
    assert second.result != first


@pytest.mark.seconds
def test_closing_the_iterator_ends_the_processes(tmp_path: Path) -> None:
    class Enough(Exception):
        pass

    def stop(done: int) -> None:
        if (tmp_path / "pid").exists():
            assert done == 7
            raise Enough

    with (
        pytest.raises(Enough),
        closing(call_in_processes([partial(wait, tmp_path)], 1, stop)) as ended,
    ):
        next(ended)
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "pid").read_text()), 0)


def test_a_process_that_cannot_be_started(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    with pytest.raises(ProcessGone, match="No such file"):
        next(call_in_processes([partial(double, 1)], 1))
