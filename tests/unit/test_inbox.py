"""The bounded queue: it never holds too much, waits a little, and counts what it turns away."""

import threading

import pytest

from eventsrc.gaps import Gap
from eventsrc.recorder import queue as inbox_module
from eventsrc.recorder.queue import MOST_KEYS, OTHER_KEYS, Inbox
from eventsrc.robot.acks import sent_key
from eventsrc.transport.session import Received, SequenceNumber
from tests.fixtures_zenoh import DEADLINE_S


def _message(text: str, key: str = "tb/detections") -> Received:
    return Received(key, text.encode())


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
    inbox = Inbox(2, patience_s=0)
    for text in "abcd":
        inbox.put(_message(text))
    inbox.put(_message("e", key="tb/other"))
    assert inbox.overflowed == 3
    assert inbox.take_overflow() == {"tb/detections": 2, "tb/other": 1}
    assert inbox.take_overflow() == {}
    assert inbox.overflowed == 3, "the total stays"
    assert _texts(inbox.take(10, 0)) == ["a", "b"]


def test_bytes_are_bounded_too_but_one_message_always_fits() -> None:
    inbox = Inbox(10, max_bytes=4, patience_s=0)
    inbox.put(_message("larger than that"))
    inbox.put(_message("x"))
    assert inbox.overflowed == 1
    assert _texts(inbox.take(10, 0)) == ["larger than that"]
    for text in ("ab", "cd", "e"):
        inbox.put(_message(text))
    assert _texts(inbox.take(10, 0)) == ["ab", "cd"]
    inbox.put(_message("ok"))
    assert _texts(inbox.take(10, 0)) == ["ok"], "taking makes room again"


def test_what_was_turned_away_has_come_all_the_same() -> None:
    """A message is lost in the queue or on the way, never both."""
    inbox = Inbox(1, patience_s=0)
    for value in (0, 1, 4):
        inbox.put(Received("tb/detections", b"x", SequenceNumber("zid:1", value)))
    assert inbox.take_missed(None) == [Gap("zid:1", 2, 3)]
    assert inbox.take_missed(None) == []
    assert (inbox.overflowed, inbox.missed) == (2, 2)


def test_how_far_a_robot_has_got_is_no_message_that_is_lost() -> None:
    inbox = Inbox(1, patience_s=0)
    for text in "ab":
        inbox.put(_message(text, key=sent_key("tb/detections")))
    assert inbox.overflowed == 0
    assert _texts(inbox.take(9, 0)) == ["a"]


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


def _putting(inbox: Inbox, *texts: str) -> threading.Thread:
    def put() -> None:
        for text in texts:
            inbox.put(_message(text))

    thread = threading.Thread(target=put)
    thread.start()
    return thread


def test_a_full_queue_slows_the_sender_down_and_loses_nothing() -> None:
    inbox = Inbox(2, patience_s=DEADLINE_S)
    texts = [str(n) for n in range(500)]
    sender = _putting(inbox, *texts)
    taken: list[str] = []
    while len(taken) < len(texts):
        batch = inbox.take(3, DEADLINE_S)
        assert 0 < len(batch) <= 2
        taken += _texts(batch)
    sender.join(DEADLINE_S)
    assert taken == texts
    assert inbox.overflowed == 0


def test_patience_ends_once_and_comes_back_with_room() -> None:
    """A sender that waits for ever would hang this test: only the first loss may take time."""
    inbox = Inbox(4, patience_s=0.01)
    for n in range(20_000):
        inbox.put(_message(str(n)))
    assert inbox.overflowed == 20_000 - 4
    inbox.take(1, 0)
    inbox.put(_message("fits"))
    inbox.put(_message("three quarters full is no reason to wait"))
    assert inbox.overflowed == 20_000 - 3
    inbox.take(2, 0)
    inbox._patience_s = DEADLINE_S
    sender = _putting(inbox, "a", "b", "c")
    assert _texts(inbox.take(4, 0))[:2] == ["3", "fits"]
    sender.join(DEADLINE_S)
    assert inbox.overflowed == 20_000 - 3


def test_the_end_ends_all_waiting_for_room() -> None:
    inbox = Inbox(1, patience_s=DEADLINE_S * 10)
    inbox.put(_message("a"))
    sender = _putting(inbox, "b", "c")
    inbox.close()
    sender.join(DEADLINE_S)
    assert not sender.is_alive()
    assert _texts(inbox.take(5, 0)) == ["a"]
    assert inbox.overflowed == 2


def test_what_waits_at_the_end_is_still_taken() -> None:
    inbox = Inbox(2)
    inbox.put(_message("a"))
    inbox.close()
    assert _texts(inbox.take(1, DEADLINE_S)) == ["a"]
    assert inbox.take(1, DEADLINE_S) == []


def test_a_queue_for_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="at least 1"):
        Inbox(0)


def test_large_messages_are_taken_a_few_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is taken makes room in the queue, so it must be bounded by itself."""
    monkeypatch.setattr(inbox_module, "TAKE_BYTES", 5)
    inbox = Inbox(10)
    for text in ("abc", "de", "f", "larger than that", "g"):
        inbox.put(_message(text))
    assert _texts(inbox.take(10, 0)) == ["abc", "de"]
    assert _texts(inbox.take(10, 0)) == ["f", "larger than that"]
    assert _texts(inbox.take(10, 0)) == ["g"]


def test_messages_that_are_too_large_are_counted_by_key() -> None:
    inbox = Inbox(1)
    for key in ("a", "b", "a"):
        inbox.refuse(key, None)
    assert inbox.too_large == 3
    assert inbox.take_too_large() == {"a": 2, "b": 1}
    assert inbox.take_too_large() == {}


def test_the_keys_that_losses_are_counted_for_are_bounded() -> None:
    inbox = Inbox(1, patience_s=0)
    inbox.put(_message("fits"))
    for number in range(MOST_KEYS + 5):
        inbox.put(_message("x", key=f"k/{number}"))
    inbox.put(_message("x", key="k/0"))
    counts = inbox.take_overflow()
    assert len(counts) == MOST_KEYS + 1
    assert counts[OTHER_KEYS] == 5
    assert counts["k/0"] == 2
    inbox.put(_message("x", key="k" * 20_000))
    assert inbox.take_overflow() == {OTHER_KEYS: 1}
