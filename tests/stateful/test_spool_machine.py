"""The spool against a list: publish, acknowledge, look, and reopen in any order."""

import shutil
import tempfile
from pathlib import Path

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from eventsrc.acks import Ack
from eventsrc.errors import SpoolFull
from eventsrc.spool import Spool, Spooled

MAX_BYTES = 60
runs = st.sampled_from(["run-a", "run-b"])
keyframes = st.integers(0, 9)


class SpoolMachine(RuleBasedStateMachine):
    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp())
        self.spool = self._open()
        self.waiting: list[tuple[int, str, int, bytes]] = []
        self.last_seq = 0

    def _open(self) -> Spool:
        return Spool(self.folder / "spool", MAX_BYTES)

    @rule(run_id=runs, keyframe_id=keyframes, payload=st.binary(max_size=12))
    def add(self, run_id: str, keyframe_id: int, payload: bytes) -> None:
        room = MAX_BYTES - sum(len(entry[3]) for entry in self.waiting)
        try:
            self.spool.add(run_id, keyframe_id, payload)
        except SpoolFull:
            assert len(payload) > room
            return
        assert len(payload) <= room
        self.last_seq += 1
        self.waiting.append((self.last_seq, run_id, keyframe_id, payload))

    @rule(run_id=runs, ends=st.lists(st.tuples(keyframes, keyframes), min_size=1, max_size=3))
    def acknowledge(self, run_id: str, ends: list[tuple[int, int]]) -> None:
        ack = Ack(run_id=run_id, log_id="log", stretches=tuple(ends))
        kept = [e for e in self.waiting if not (e[1] == run_id and ack.covers(e[2]))]
        assert self.spool.acknowledge(ack) == len(self.waiting) - len(kept)
        self.waiting = kept

    @rule(seq=st.integers(0, 30), limit=st.integers(0, 5))
    def look(self, seq: int, limit: int) -> None:
        after = [Spooled(s, run_id, p) for s, run_id, _, p in self.waiting if s > seq]
        assert self.spool.after(seq, limit) == after[:limit]
        assert self.spool.waiting_up_to(seq) == len(self.waiting) - len(after)

    @rule()
    def reopen(self) -> None:
        self.spool.close()
        self.spool = self._open()

    @invariant()
    def counts_what_waits(self) -> None:
        assert len(self.spool) == len(self.waiting)

    def teardown(self) -> None:
        self.spool.close()
        shutil.rmtree(self.folder)


TestSpool = SpoolMachine.TestCase
TestSpool.settings = settings(max_examples=30, stateful_step_count=30, deadline=None)
