"""Messages are checked while a commit waits for the disk: the same log, commit after commit."""

import errno
import os
import tempfile
import threading
import time
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eventsrc.base.errors import LogError
from eventsrc.envelope.model import ENVELOPE_VERSION
from eventsrc.log import ALWAYS, LogWriter, active_segment
from eventsrc.record.append import append_payload
from eventsrc.record.recorder.queue import MessageQueue
from eventsrc.record.recorder.writer_thread import WriterThread
from eventsrc.record.robot.acks import Ack, payload_sha256
from eventsrc.record.transport.session import Received
from tests.support.envelopes import detection, envelope, payload
from tests.support.fixtures_log import KEY, MEMORY_DISK, read_log
from tests.support.thorough import examples

DEADLINE_S = 30.0
GROUP = 256

PAYLOADS = st.one_of(
    st.integers(0, 40).map(lambda n: payload(envelope(n))),
    st.integers(0, 40).map(lambda n: payload(envelope(n, detections=[detection("cup", [1.0, n])]))),
    st.integers(1, 40).map(lambda n: payload(envelope(n, timestamp="late"))),
    st.lists(st.sampled_from(["cup", "book"]), max_size=2).map(
        lambda names: payload(
            [
                {"class_name": name, "confidence": 0.5, "bbox": [0.0, 0.0, 1.0, 1.0]}
                for name in names
            ]
        )
    ),
    st.binary(max_size=30),
)
KEYS = st.sampled_from([KEY, "tb/other", "mapfold/loss"])


class Recorded:
    """A writer thread without Zenoh, and the replies it sends."""

    def __init__(self, log: Path, messages: list[Received], **options: object) -> None:
        self.queue = MessageQueue(size=10_000)
        self.replies: list[tuple[str, bytes]] = []
        self.writer = LogWriter(log, **options)  # type: ignore[arg-type]
        self.thread = WriterThread(
            self.queue,
            self.writer,
            None,
            lambda key, reply: self.replies.append((key, reply)),
            max_events=None,
            report_gaps=False,
            max_payload_bytes=2**20,
        )
        for message in messages:
            self.queue.put(message)

    @property
    def acknowledged(self) -> list[str]:
        """The digests of all payloads that were acknowledged, in order."""
        acks = [Ack.decode(reply) for key, reply in self.replies if "/refused/" not in key]
        return [sha256 for ack in acks for sha256 in ack.sha256]


@settings(max_examples=examples(30))
@given(st.lists(st.tuples(KEYS, PAYLOADS), max_size=40))
def test_the_log_is_that_of_appending_one_by_one(messages: list[tuple[str, bytes]]) -> None:
    with tempfile.TemporaryDirectory(dir=MEMORY_DISK if MEMORY_DISK.is_dir() else None) as name:
        folder = Path(name)
        recorded = Recorded(
            folder / "recorded", [Received(*message) for message in messages], clock=lambda: 10**18
        )
        recorded.queue.close()
        recorded.thread.run()
        recorded.writer.close()
        with LogWriter(folder / "appended", clock=lambda: 10**18) as writer:
            for key, raw in messages:
                append_payload(writer, key, raw, max_bytes=2**20)
        events = read_log(folder / "recorded")
        assert events == read_log(folder / "appended")
        report = recorded.thread.report()
        assert report.recorded + report.rejected == len(events) == len(messages)
        assert report.rejected == sum(event.key == "mapfold/rejected" for event in events)
        valid = [e for e in events if e.key != "mapfold/rejected" and e.version == ENVELOPE_VERSION]
        assert sorted(recorded.acknowledged) == sorted(payload_sha256(e.payload) for e in valid)


class SlowDisk:
    """Syncs wait at a gate; ``broken`` makes them fail behind it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, broken: bool = False) -> None:
        self.entered = threading.Semaphore(0)
        self.gate = threading.Semaphore(0)
        real = active_segment.sync_file

        def sync_file(fd: int) -> None:
            self.entered.release()
            assert self.gate.acquire(timeout=DEADLINE_S)
            if broken:
                raise OSError(errno.EIO, os.strerror(errno.EIO))
            real(fd)

        monkeypatch.setattr(active_segment, "sync_file", sync_file)


def keyframes(count: int) -> list[Received]:
    return [Received(KEY, payload(envelope(number))) for number in range(count)]


def wait_for_depth(queue: MessageQueue, depth: int) -> None:
    """Wait until so many messages are left, and watch that no more are taken."""
    deadline = time.monotonic() + DEADLINE_S
    while queue.depth() > depth and time.monotonic() < deadline:
        threading.Event().wait(0.001)
    threading.Event().wait(0.05)
    assert queue.depth() == depth


def test_while_a_group_is_synced_one_batch_is_checked_and_nothing_appended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    messages = keyframes(4 * GROUP)
    recorded = Recorded(tmp_path / "log", messages)
    disk = SlowDisk(monkeypatch)
    recorded.queue.close()
    running = threading.Thread(target=recorded.thread.run)
    running.start()
    for group in range(4):
        assert disk.entered.acquire(timeout=DEADLINE_S)
        wait_for_depth(recorded.queue, max(0, 2 - group) * GROUP)
        assert recorded.writer.next_offset == (group + 1) * GROUP
        assert recorded.writer.durable_offset == group * GROUP
        assert len(recorded.acknowledged) == group * GROUP
        disk.gate.release()
    running.join(DEADLINE_S)
    assert not running.is_alive()
    assert recorded.acknowledged == [payload_sha256(m.payload) for m in messages]
    disk.gate.release(10)
    recorded.writer.close()
    assert [e.payload for e in read_log(tmp_path / "log")] == [m.payload for m in messages]


def test_what_was_checked_ahead_of_a_failing_disk_counts_as_unwritten(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded = Recorded(tmp_path / "log", keyframes(4 * GROUP))
    disk = SlowDisk(monkeypatch, broken=True)
    failed: list[LogError] = []

    def run() -> None:
        try:
            recorded.thread.run()
        except LogError as error:
            failed.append(error)

    running = threading.Thread(target=run)
    running.start()
    assert disk.entered.acquire(timeout=DEADLINE_S)
    wait_for_depth(recorded.queue, 2 * GROUP)
    disk.gate.release(10)
    running.join(DEADLINE_S)
    assert len(failed) == 1
    report = recorded.thread.report()
    assert (report.recorded, report.unwritten, report.lost) == (0, 4 * GROUP, 4 * GROUP)
    assert recorded.replies == []
    with pytest.raises(LogError):
        recorded.writer.close()


def test_no_more_than_max_events_are_taken_from_the_queue(tmp_path: Path) -> None:
    recorded = Recorded(tmp_path / "log", keyframes(3 * GROUP), fsync=ALWAYS)
    recorded.thread = WriterThread(
        recorded.queue,
        recorded.writer,
        None,
        lambda _key, _reply: None,
        max_events=GROUP + 7,
        report_gaps=False,
        max_payload_bytes=2**20,
    )
    recorded.thread.run()
    recorded.writer.close()
    assert len(read_log(tmp_path / "log")) == GROUP + 7
    assert recorded.queue.depth() == 2 * GROUP - 7
