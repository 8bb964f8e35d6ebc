"""The log against a plain list: append, sync, rotate, crash, recover, read, tail, in any order.

A crash is a copy of the folder as another process would find it: the writer's uncommitted events
are gone, and the growing file may be cut anywhere behind its last synced byte, with or without its
last commit mark.

Every step waits for the sealing it began: Hypothesis replays what it finds, and a step whose end
depends on how far another thread has come does not replay. What readers see while a segment is
being sealed is asked where the moment can be chosen (tests/unit/test_log_commit.py) and under load
(tests/integration/test_log_tail.py).
"""

import contextlib
import shutil
import tempfile
import threading
from pathlib import Path

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from eventsrc.base.errors import LogError
from eventsrc.log import Event, FsyncPolicy, LogReader, LogWriter, follow, recover_log, verify_log
from eventsrc.log.mcap_records import MARK_BYTES
from eventsrc.record.log_info import log_info
from tests.support.fixtures_log import BY_HAND, MEMORY_DISK
from tests.support.thorough import examples

KEYS = ["tb/detections", "other/key", "mapfold/loss"]
PAYLOADS = st.binary(max_size=40)
IN_THREES = FsyncPolicy(interval_ns=10**18, max_events=3)


class LogMachine(RuleBasedStateMachine):
    """``written`` is what was appended, ``durable`` how much of it must survive anything."""

    def __init__(self) -> None:
        super().__init__()
        base = MEMORY_DISK if MEMORY_DISK.is_dir() else None
        self.folder = Path(tempfile.mkdtemp(dir=base))
        self.path = self.folder / "0"
        self.crashes = 0
        self.written: list[Event] = []
        self.durable = 0
        self.stop = threading.Event()

    @initialize(
        rotate_events=st.sampled_from([1, 5, 1000]), policy=st.sampled_from([BY_HAND, IN_THREES])
    )
    def begin(self, rotate_events: int, policy: FsyncPolicy) -> None:
        self.rotate_events = rotate_events
        self.policy = policy
        self.writer: LogWriter | None = None
        self.open_writer()
        self.tail = follow(self.path, 0, stop=self.stop)
        self.tailed = 0

    def open_writer(self) -> None:
        self.writer = LogWriter(
            self.path,
            fsync=self.policy,
            rotate_events=self.rotate_events,
        )
        self.base = self.writer._active.base
        self.writer._sealer.finish()  # of what its predecessor left
        assert self.durable <= self.writer.next_offset <= len(self.written)
        self.written = self.written[: self.writer.next_offset]
        self.durable = self.writer.durable_offset
        assert self.durable == len(self.written)

    def let_seal(self) -> None:
        """Wait for the sealing that a rotation began, if there was one."""
        assert self.writer is not None
        if self.writer._active.base > self.base:
            self.base = self.writer._active.base
            self.writer._sealer.finish()

    def note_durable(self) -> None:
        """What the writer says now: never less than before, never more than was appended."""
        assert self.writer is not None
        durable = self.writer.durable_offset
        assert self.durable <= durable <= len(self.written)
        self.durable = durable

    @precondition(lambda self: self.writer is None)
    @rule()
    def recover(self) -> None:
        report = recover_log(self.path)
        assert not any(segment.gaps or segment.kept_copy for segment in report.segments)
        assert self.durable <= report.events <= len(self.written)
        self.written = self.written[: report.events]
        self.durable = report.events
        with LogReader(self.path) as reader:
            assert list(reader.read()) == self.written
        assert recover_log(self.path).segments == ()

    @precondition(lambda self: self.writer is None)
    @rule()
    def start_again(self) -> None:
        self.open_writer()

    @precondition(lambda self: self.writer is not None)
    @rule(key=st.sampled_from(KEYS), payload=PAYLOADS, logged=st.integers(0, 2**63 - 1))
    def append(self, key: str, payload: bytes, logged: int) -> None:
        assert self.writer is not None
        offset = self.writer.append(key, payload, logged_ns=logged, stamp_ns=logged // 2)
        self.let_seal()
        self.written.append(Event(offset, key, logged, logged // 2, payload))
        assert offset == len(self.written) - 1
        self.note_durable()  # a full segment is rotated, which commits

    @precondition(lambda self: self.writer is not None)
    @rule(commits=st.lists(st.integers(1, 3), min_size=2, max_size=6), key=st.sampled_from(KEYS))
    def append_and_sync(self, commits: list[int], key: str) -> None:
        for count in commits:
            for _ in range(count):
                self.append(key, b"%d" % len(self.written), len(self.written))
            self.sync(rotate=False)

    @precondition(lambda self: self.writer is not None)
    @rule(rotate=st.booleans())
    def sync(self, rotate: bool) -> None:
        assert self.writer is not None
        self.durable = self.writer.sync()
        assert self.durable == len(self.written)
        if rotate:
            self.writer.commit_if_due()  # rotates when the segment is full
            self.let_seal()

    @precondition(lambda self: self.writer is not None)
    @rule()
    def close(self) -> None:
        assert self.writer is not None
        self.writer.close()
        self.writer = None
        self.durable = len(self.written)

    @precondition(lambda self: self.writer is not None)
    @rule(half_written=st.booleans(), keep=st.floats(0, 1), without_mark=st.booleans())
    def crash(self, half_written: bool, keep: float, without_mark: bool) -> None:
        assert self.writer is not None
        self.note_durable()
        synced_bytes = self.writer._active.size
        has_commit = self.writer._active.committed > self.writer._active.base
        if half_written:
            self.writer.sync()  # what reached the file, of which the cut below leaves a part
        self.crashes += 1
        copy = self.folder / str(self.crashes)
        shutil.copytree(self.path, copy)
        growing = copy / self.writer._active.path.name
        size = growing.stat().st_size
        cut = synced_bytes + int((size - synced_bytes) * keep)
        if without_mark and has_commit and cut == synced_bytes:
            cut -= MARK_BYTES
        with growing.open("r+b") as file:
            file.truncate(cut)
        with contextlib.suppress(LogError):
            self.writer.close()
        self.writer = None
        self.path = copy
        self.tail.close()
        self.tail = follow(self.path, self.tailed, stop=self.stop)

    @rule(data=st.data())
    def read_a_range(self, data: st.DataObject) -> None:
        start = data.draw(st.integers(0, len(self.written) + 1))
        end = data.draw(st.none() | st.integers(0, len(self.written) + 1))
        keys = data.draw(st.none() | st.sets(st.sampled_from(KEYS)))
        with LogReader(self.path) as reader:
            shown = self.written[: reader.next_offset]
            if self.writer is not None:
                assert reader.next_offset == self.durable
            expected = [e for e in shown[start:end] if keys is None or e.key in keys]
            assert list(reader.read(start, end, keys=keys)) == expected

    @rule()
    def tail_to_the_end(self) -> None:
        for event in self.tail:
            if event is None:
                break
            assert event == self.written[self.tailed]
            self.tailed += 1
        if self.writer is not None:
            assert self.tailed == self.durable

    @precondition(lambda self: self.writer is None)
    @rule()
    def verify(self) -> None:
        kinds = {finding.kind for finding in verify_log(self.path).findings}
        assert kinds <= {"schema", "time", "torn"}
        assert log_info(self.path).events <= len(self.written)

    @invariant()
    def nothing_durable_is_gone(self) -> None:
        if self.writer is not None:
            assert self.writer.durable_offset == self.durable

    def teardown(self) -> None:
        self.stop.set()
        self.tail.close()
        if self.writer is not None:
            self.writer.close()
        shutil.rmtree(self.folder)


LogMachine.TestCase.settings = settings(
    max_examples=examples(100),
    stateful_step_count=40,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
)
TestLogMachine = LogMachine.TestCase
