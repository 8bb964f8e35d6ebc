"""The bounded queue between Zenoh and the writer thread: its limits, waiting, and loss counts."""

import threading

import pytest

from eventsrc.envelope.gaps import Gap
from eventsrc.record.recorder import queue as queue_module
from eventsrc.record.recorder.queue import MAX_KEYS, OTHER_KEYS, MessageQueue
from eventsrc.record.robot.acks import sent_key
from eventsrc.record.transport.session import Received, SequenceNumber
from tests.support.fixtures_zenoh import DEADLINE_S


def _message(text: str, key: str = "tb/detections") -> Received:
    return Received(key, text.encode())


def _texts(messages: list[Received]) -> list[str]:
    return [message.payload.decode() for message in messages]


def test_batches_are_first_in_first_out() -> None:
    queue = MessageQueue(10)
    for text in "abcde":
        queue.put(_message(text))
    assert queue.depth() == 5
    assert _texts(queue.get(3, 0)) == ["a", "b", "c"]
    assert _texts(queue.get(3, 0)) == ["d", "e"]
    assert queue.get(3, 0) == []


def test_overflow_is_counted_by_key_and_drained_once() -> None:
    queue = MessageQueue(2, max_wait_s=0)
    for text in "abcd":
        queue.put(_message(text))
    queue.put(_message("e", key="tb/other"))
    assert queue.overflowed == 3
    assert queue.drain_overflow() == {"tb/detections": 2, "tb/other": 1}
    assert queue.drain_overflow() == {}
    assert queue.overflowed == 3, "the total stays"
    assert _texts(queue.get(10, 0)) == ["a", "b"]


def test_bytes_are_bounded_but_one_message_always_fits() -> None:
    queue = MessageQueue(10, max_bytes=4, max_wait_s=0)
    queue.put(_message("larger than that"))
    queue.put(_message("x"))
    assert queue.overflowed == 1
    assert _texts(queue.get(10, 0)) == ["larger than that"]
    for text in ("ab", "cd", "e"):
        queue.put(_message(text))
    assert _texts(queue.get(10, 0)) == ["ab", "cd"]
    queue.put(_message("ok"))
    assert _texts(queue.get(10, 0)) == ["ok"], "taking makes room again"


def test_an_overflowed_message_is_no_gap_in_the_sequence_numbers() -> None:
    """A message is lost in the queue or on the way, never both."""
    queue = MessageQueue(1, max_wait_s=0)
    for value in (0, 1, 4):
        queue.put(Received("tb/detections", b"x", SequenceNumber("zid:1", value)))
    assert queue.drain_missed(None) == [Gap("zid:1", 2, 3)]
    assert queue.drain_missed(None) == []
    assert (queue.overflowed, queue.missed) == (2, 2)


def test_an_announcement_that_does_not_fit_is_not_counted_as_lost() -> None:
    queue = MessageQueue(1, max_wait_s=0)
    for text in "ab":
        queue.put(_message(text, key=sent_key("tb/detections")))
    assert queue.overflowed == 0
    assert _texts(queue.get(9, 0)) == ["a"]


def test_a_message_wakes_a_waiting_get() -> None:
    queue = MessageQueue(1)
    taken: list[list[Received]] = []
    taker = threading.Thread(target=lambda: taken.append(queue.get(1, DEADLINE_S)))
    taker.start()
    queue.put(_message("a"))
    taker.join(DEADLINE_S)
    assert _texts(taken[0]) == ["a"]


def test_close_wakes_a_waiting_get() -> None:
    queue = MessageQueue(1)
    taker = threading.Thread(target=lambda: queue.get(1, DEADLINE_S * 10))
    taker.start()
    queue.close()
    taker.join(DEADLINE_S)
    assert not taker.is_alive()
    assert queue.closed


def _putting(queue: MessageQueue, *texts: str) -> threading.Thread:
    def put() -> None:
        for text in texts:
            queue.put(_message(text))

    thread = threading.Thread(target=put)
    thread.start()
    return thread


def test_a_full_queue_slows_the_sender_down_and_loses_nothing() -> None:
    queue = MessageQueue(2, max_wait_s=DEADLINE_S)
    texts = [str(n) for n in range(500)]
    sender = _putting(queue, *texts)
    taken: list[str] = []
    while len(taken) < len(texts):
        batch = queue.get(3, DEADLINE_S)
        assert 0 < len(batch) <= 2
        taken += _texts(batch)
    sender.join(DEADLINE_S)
    assert taken == texts
    assert queue.overflowed == 0


def test_messages_put_together_wake_who_waits_before_they_wait_for_room() -> None:
    queue = MessageQueue(2, max_wait_s=DEADLINE_S)
    texts = [str(n) for n in range(100)]
    taken: list[str] = []

    def take() -> None:
        while len(taken) < len(texts):
            taken.extend(_texts(queue.get(3, 100 * DEADLINE_S)))

    taker = threading.Thread(target=take)
    taker.start()
    queue.put_all(map(_message, texts))
    taker.join(DEADLINE_S)
    assert taken == texts
    assert queue.overflowed == 0


def test_after_one_timeout_messages_are_lost_at_once_until_half_is_free() -> None:
    """A sender that waits forever would hang this test: only the first loss may take time."""
    queue = MessageQueue(4, max_wait_s=0.01)
    for n in range(20_000):
        queue.put(_message(str(n)))
    assert queue.overflowed == 20_000 - 4
    queue.get(1, 0)
    queue.put(_message("fits"))
    queue.put(_message("three quarters full is no reason to wait"))
    assert queue.overflowed == 20_000 - 3
    queue.get(2, 0)
    queue._max_wait_s = DEADLINE_S
    sender = _putting(queue, "a", "b", "c")
    assert _texts(queue.get(4, 0))[:2] == ["3", "fits"]
    sender.join(DEADLINE_S)
    assert queue.overflowed == 20_000 - 3


def test_close_wakes_every_waiting_put() -> None:
    queue = MessageQueue(1, max_wait_s=DEADLINE_S * 10)
    queue.put(_message("a"))
    sender = _putting(queue, "b", "c")
    queue.close()
    sender.join(DEADLINE_S)
    assert not sender.is_alive()
    assert _texts(queue.get(5, 0)) == ["a"]
    assert queue.overflowed == 2


def test_messages_queued_before_close_are_still_returned() -> None:
    queue = MessageQueue(2)
    queue.put(_message("a"))
    queue.close()
    assert _texts(queue.get(1, DEADLINE_S)) == ["a"]
    assert queue.get(1, DEADLINE_S) == []


def test_a_queue_of_size_zero_is_refused() -> None:
    with pytest.raises(ValueError, match="at least 1"):
        MessageQueue(0)


def test_large_messages_are_taken_a_few_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is taken makes room in the queue, so it must be bounded by itself."""
    monkeypatch.setattr(queue_module, "MAX_BATCH_BYTES", 5)
    queue = MessageQueue(10)
    for text in ("abc", "de", "f", "larger than that", "g"):
        queue.put(_message(text))
    assert _texts(queue.get(10, 0)) == ["abc", "de"]
    assert _texts(queue.get(10, 0)) == ["f", "larger than that"]
    assert _texts(queue.get(10, 0)) == ["g"]


def test_the_number_of_keys_with_loss_counts_is_bounded() -> None:
    queue = MessageQueue(1, max_wait_s=0)
    queue.put(_message("fits"))
    for number in range(MAX_KEYS + 5):
        queue.put(_message("x", key=f"k/{number}"))
    queue.put(_message("x", key="k/0"))
    counts = queue.drain_overflow()
    assert len(counts) == MAX_KEYS + 1
    assert counts[OTHER_KEYS] == 5
    assert counts["k/0"] == 2
    queue.put(_message("x", key="k" * 20_000))
    assert queue.drain_overflow() == {OTHER_KEYS: 1}
