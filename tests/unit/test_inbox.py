"""The bounded queue: it never blocks, never holds too much, and counts what it turns away."""

import threading

import pytest

from eventsrc._zenoh import Missed, Received
from eventsrc.recorder.inbox import Inbox
from tests.fixtures_zenoh import DEADLINE_S


def _message(text: str, key: str = "tb/detections") -> Received:
    return Received(key, text.encode(), None)


def _texts(messages: list[Received]) -> list[str]:
    return [message.payload.decode() for message in messages]


def test_first_in_first_out_in_batches() -> None:
    inbox = Inbox(10)
    for text in "abcde":
        inbox.put(_message(text))
    assert inbox.depth() == 5
    assert _texts(inbox.take(3, 0)) == ["a", "b", "c"]
    assert _texts(inbox.take(3, 0)) == ["d", "e"]
    assert inbox.take(3, 0) == []


def test_what_does_not_fit_is_counted_by_key_and_told_once() -> None:
    inbox = Inbox(2)
    for text in "abcd":
        inbox.put(_message(text))
    inbox.put(_message("e", key="tb/other"))
    assert inbox.overflowed == 3
    assert inbox.take_overflow() == {"tb/detections": 2, "tb/other": 1}
    assert inbox.take_overflow() == {}
    assert inbox.overflowed == 3, "the total stays"
    assert _texts(inbox.take(10, 0)) == ["a", "b"]


def test_bytes_are_bounded_too_but_one_message_always_fits() -> None:
    inbox = Inbox(10, max_bytes=4)
    inbox.put(_message("larger than that"))
    inbox.put(_message("x"))
    assert inbox.overflowed == 1
    assert _texts(inbox.take(10, 0)) == ["larger than that"]
    for text in ("ab", "cd", "e"):
        inbox.put(_message(text))
    assert _texts(inbox.take(10, 0)) == ["ab", "cd"]
    inbox.put(_message("ok"))
    assert _texts(inbox.take(10, 0)) == ["ok"], "taking makes room again"


def test_misses_are_added_up_by_publisher() -> None:
    inbox = Inbox(1)
    for source, count in (("a", 2), ("b", 1), ("a", 3)):
        inbox.miss(Missed(source, count))
    assert inbox.missed == 6
    assert inbox.take_missed() == {"a": 5, "b": 1}
    assert inbox.take_missed() == {}


def test_a_waiting_taker_is_woken_by_a_message() -> None:
    inbox = Inbox(1)
    taken: list[list[Received]] = []
    taker = threading.Thread(target=lambda: taken.append(inbox.take(1, DEADLINE_S)))
    taker.start()
    inbox.put(_message("a"))
    taker.join(DEADLINE_S)
    assert _texts(taken[0]) == ["a"]


def test_a_waiting_taker_is_woken_by_the_end() -> None:
    inbox = Inbox(1)
    taker = threading.Thread(target=lambda: inbox.take(1, DEADLINE_S * 10))
    taker.start()
    inbox.close()
    taker.join(DEADLINE_S)
    assert not taker.is_alive()
    assert inbox.closed


def test_what_waits_at_the_end_is_still_taken() -> None:
    inbox = Inbox(2)
    inbox.put(_message("a"))
    inbox.close()
    assert _texts(inbox.take(1, DEADLINE_S)) == ["a"]
    assert inbox.take(1, DEADLINE_S) == []


def test_a_queue_for_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="at least 1"):
        Inbox(0)
