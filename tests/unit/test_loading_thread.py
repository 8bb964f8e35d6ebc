"""`LoadingThread` runs jobs in order, lets few wait, and loses no error."""

import sys
import threading
from collections.abc import Callable

import pytest

from projections.postgres.shadows import WAITING_JOBS, LoadingThread, short_turns


def test_jobs_run_in_order_in_one_other_thread() -> None:
    done: list[int] = []
    threads: set[int] = set()
    daemons: set[bool] = set()

    def job(number: int) -> Callable[[], None]:
        def work() -> None:
            done.append(number)
            threads.add(threading.get_ident())
            daemons.add(threading.current_thread().daemon)

        return work

    with LoadingThread() as loading:
        for number in range(20):
            loading.put(job(number))
        loading.flush()
        assert done == list(range(20))
    assert len(threads) == 1
    assert daemons == {True}  # a second Ctrl-C need not wait for a job
    assert threading.get_ident() not in threads


def test_put_blocks_while_too_many_jobs_wait() -> None:
    gate, brought = threading.Event(), threading.Semaphore(0)

    def bring(loading: LoadingThread) -> None:
        for _ in range(WAITING_JOBS + 3):
            loading.put(lambda: gate.wait(60) and None)
            brought.release()

    with LoadingThread() as loading:
        bringing = threading.Thread(target=bring, args=(loading,))
        bringing.start()
        for _ in range(WAITING_JOBS + 1):  # one in work, the others wait
            assert brought.acquire(timeout=60)
        assert not brought.acquire(timeout=0.05)
        gate.set()
        bringing.join(60)
        assert not bringing.is_alive()
        loading.flush()


def _fail() -> None:
    raise LookupError("the server went away")


def test_a_failed_job_is_raised_by_flush_and_put_and_ends_the_work() -> None:
    done, gate = list[int](), threading.Event()

    def fail() -> None:
        gate.wait(60)
        _fail()

    with LoadingThread() as loading:
        loading.put(fail)
        loading.put(lambda: done.append(1))
        gate.set()
        with pytest.raises(LookupError, match="went away"):
            loading.flush()
        with pytest.raises(LookupError, match="went away"):
            loading.put(lambda: done.append(2))
    assert done == []


def test_an_error_inside_cancels_the_running_job_and_drops_the_rest() -> None:
    cancelled, begun, done = threading.Event(), threading.Event(), list[int]()

    def first() -> None:
        begun.set()
        done.append(1 if cancelled.wait(60) else 0)

    def leave() -> None:
        with LoadingThread(cancelled.set) as loading:
            loading.put(first)
            loading.put(lambda: done.append(2))
            assert begun.wait(60)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        leave()
    assert done == [1]


def test_the_thread_ends_also_when_cancelling_fails() -> None:
    def leave() -> None:
        with LoadingThread(_fail):
            raise KeyboardInterrupt

    before = threading.active_count()
    with pytest.raises(LookupError):
        leave()
    assert threading.active_count() == before


def test_the_switch_interval_is_short_only_inside() -> None:
    before = sys.getswitchinterval()
    with short_turns():
        assert sys.getswitchinterval() < before
    assert sys.getswitchinterval() == before
