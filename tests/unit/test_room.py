"""The waiting room: bounded, fair to those who ask, and never silent."""

import threading
from collections.abc import Iterator
from concurrent.futures import Future

import pytest
from hypothesis import given
from hypothesis import strategies as st

from projections.serve.answering import BusyError
from projections.serve.room import Room

DEADLINE_S = 30.0


class Held:
    """A room whose only worker is held up until `let_go`; it then notes what it works on."""

    def __init__(self, waiting: int, patience_s: float = DEADLINE_S) -> None:
        self.room = Room(1, waiting=waiting, patience_s=patience_s)
        self.done: list[str] = []
        self._begun, self._go = threading.Event(), threading.Event()
        self.room.submit("first", self._hold)
        assert self._begun.wait(DEADLINE_S)

    def _hold(self) -> None:
        self._begun.set()
        assert self._go.wait(DEADLINE_S)

    def ask(self, name: str) -> "Future[None]":
        return self.room.submit(name[0], lambda: self.done.append(name))

    def let_go(self) -> None:
        self._go.set()
        self.room.close()


@pytest.fixture
def held() -> Iterator[Held]:
    held = Held(waiting=6)
    yield held
    held.let_go()


def test_peers_take_turns(held: Held) -> None:
    for name in ("a1", "a2", "a3", "b1", "c1", "c2"):
        held.ask(name)
    held.let_go()
    assert held.done == ["a1", "b1", "c1", "a2", "c2", "a3"]


def test_a_full_room_refuses_the_newest_of_the_peer_with_most_in_it(held: Held) -> None:
    flood = [held.ask(f"a{number}") for number in range(20)]
    for future in flood[6:]:
        with pytest.raises(BusyError):
            future.result(DEADLINE_S)
    other = held.ask("b1")
    with pytest.raises(BusyError):
        flood[5].result(DEADLINE_S)
    held.let_go()
    assert other.done()
    assert held.done == ["a0", "b1", "a1", "a2", "a3", "a4"]


def test_what_has_waited_for_too_long_is_refused_while_all_workers_are_held_up() -> None:
    held = Held(waiting=6, patience_s=0.05)
    try:
        with pytest.raises(BusyError, match="ask again later"):
            held.ask("a1").result(DEADLINE_S)
    finally:
        held.let_go()
    assert held.done == []


def test_a_closed_room_did_what_it_took_and_refuses_what_comes_later(held: Held) -> None:
    taken = held.ask("a1")
    held.let_go()
    assert taken.done()
    with pytest.raises(BusyError):
        held.ask("a2").result(DEADLINE_S)
    assert held.done == ["a1"]


def test_an_error_comes_to_who_asked() -> None:
    with Room(1) as room:
        failed = room.submit("a", lambda: 1 // 0)
        with pytest.raises(ZeroDivisionError):
            failed.result(DEADLINE_S)
        assert room.submit("a", lambda: 7).result(DEADLINE_S) == 7


@given(st.lists(st.sampled_from("abc"), max_size=40))
def test_everyone_hears_and_a_peer_below_its_share_is_never_refused(peers: list[str]) -> None:
    held = Held(waiting=9)
    futures = [(peer, held.ask(f"{peer}{n}")) for n, peer in enumerate(peers)]
    held.let_go()
    refused = [peer for peer, future in futures if isinstance(future.exception(0), BusyError)]
    assert len(held.done) + len(refused) == len(peers)
    assert len(held.done) == min(len(peers), 9)
    for peer in set(refused):
        assert sum(name[0] == peer for name in held.done) >= 3
