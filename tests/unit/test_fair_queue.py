"""The question queue: bounded, fair to peers, and every question gets an answer or a refusal."""

import threading
from collections.abc import Iterator
from concurrent.futures import Future

import pytest
from hypothesis import given
from hypothesis import strategies as st

from projections.surfaces.serve.answering import BusyError
from projections.surfaces.serve.fair_queue import FairQueue

DEADLINE_S = 30.0


class BlockedQueue:
    """A queue whose only worker is blocked until `release`; it then records what it works on."""

    def __init__(self, capacity: int, max_wait_s: float = DEADLINE_S) -> None:
        self.queue = FairQueue(1, capacity=capacity, max_wait_s=max_wait_s)
        self.done: list[str] = []
        self._begun, self._go = threading.Event(), threading.Event()
        self.queue.submit("first", self._block)
        assert self._begun.wait(DEADLINE_S)

    def _block(self) -> None:
        self._begun.set()
        assert self._go.wait(DEADLINE_S)

    def ask(self, name: str) -> "Future[None]":
        return self.queue.submit(name[0], lambda: self.done.append(name))

    def release(self) -> None:
        self._go.set()
        self.queue.close()


@pytest.fixture
def blocked() -> Iterator[BlockedQueue]:
    blocked = BlockedQueue(capacity=6)
    yield blocked
    blocked.release()


def test_peers_take_turns(blocked: BlockedQueue) -> None:
    for name in ("a1", "a2", "a3", "b1", "c1", "c2"):
        blocked.ask(name)
    blocked.release()
    assert blocked.done == ["a1", "b1", "c1", "a2", "c2", "a3"]


def test_a_full_queue_refuses_the_newest_of_the_peer_with_the_most(blocked: BlockedQueue) -> None:
    flood = [blocked.ask(f"a{number}") for number in range(20)]
    for future in flood[6:]:
        with pytest.raises(BusyError):
            future.result(DEADLINE_S)
    other = blocked.ask("b1")
    with pytest.raises(BusyError):
        flood[5].result(DEADLINE_S)
    blocked.release()
    assert other.done()
    assert blocked.done == ["a0", "b1", "a1", "a2", "a3", "a4"]


def test_a_question_that_waited_too_long_is_refused_while_all_workers_are_blocked() -> None:
    blocked = BlockedQueue(capacity=6, max_wait_s=0.05)
    try:
        with pytest.raises(BusyError, match="ask again later"):
            blocked.ask("a1").result(DEADLINE_S)
    finally:
        blocked.release()
    assert blocked.done == []


def test_a_closed_queue_has_finished_its_work_and_refuses_new(blocked: BlockedQueue) -> None:
    queued = blocked.ask("a1")
    blocked.release()
    assert queued.done()
    with pytest.raises(BusyError):
        blocked.ask("a2").result(DEADLINE_S)
    assert blocked.done == ["a1"]


def test_an_error_is_raised_by_the_future() -> None:
    with FairQueue(1) as queue:
        failed = queue.submit("a", lambda: 1 // 0)
        with pytest.raises(ZeroDivisionError):
            failed.result(DEADLINE_S)
        assert queue.submit("a", lambda: 7).result(DEADLINE_S) == 7


@given(st.lists(st.sampled_from("abc"), max_size=40))
def test_every_question_ends_and_a_peer_below_its_share_is_never_refused(peers: list[str]) -> None:
    blocked = BlockedQueue(capacity=9)
    futures = [(peer, blocked.ask(f"{peer}{n}")) for n, peer in enumerate(peers)]
    blocked.release()
    refused = [peer for peer, future in futures if isinstance(future.exception(0), BusyError)]
    assert len(blocked.done) + len(refused) == len(peers)
    assert len(blocked.done) == min(len(peers), 9)
    for peer in set(refused):
        assert sum(name[0] == peer for name in blocked.done) >= 3
