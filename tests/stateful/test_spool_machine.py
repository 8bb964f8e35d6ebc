"""The spool against two lists: publish, acknowledge, refuse, retry, look, reopen in any order."""

import shutil
import tempfile
from pathlib import Path

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from eventsrc.base.errors import SpoolFull
from eventsrc.record.robot.acks import Ack, Refusal, Refusals, payload_sha256
from eventsrc.record.robot.spool import Refused, Spool, Spooled
from tests.support.thorough import examples

MAX_BYTES = 60
runs = st.sampled_from(["run-a", "run-b"])
keyframes = st.integers(0, 9)


class SpoolMachine(RuleBasedStateMachine):
    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp())
        self.spool = self._open()
        self.waiting: list[tuple[int, str, int, bytes]] = []
        # The last is the digest, which stays when the payload has given way.
        self.aside: list[tuple[int, str, int, bytes | None, str]] = []
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
        self._make_room(room - len(payload))
        self.last_seq += 1
        self.waiting.append((self.last_seq, run_id, keyframe_id, payload))

    def _make_room(self, room: int) -> None:
        """The oldest payloads set aside go until what is left fits ``room`` bytes."""
        for index, (seq, run_id, keyframe_id, _, digest) in enumerate(self.aside):
            if sum(len(entry[3] or b"") for entry in self.aside) <= room:
                break
            self.aside[index] = (seq, run_id, keyframe_id, None, digest)

    @rule(data=st.data(), up_to=st.integers(0, 30))
    def refuse(self, data: st.DataObject, up_to: int) -> None:
        known = [entry[3] for entry in self.waiting] or [b"nothing"]
        refused = data.draw(st.lists(st.sampled_from(known), min_size=1, max_size=3))
        said = tuple(Refusal.of(payload, "too blue") for payload in refused)
        moved = [e for e in self.waiting if e[3] in refused and e[0] <= up_to]
        assert self.spool.refuse(Refusals(log_id="log", refused=said), up_to) == len(moved)
        self.waiting = [e for e in self.waiting if e not in moved]
        shelved = [(*entry, payload_sha256(entry[3])) for entry in moved]
        self.aside = sorted([*self.aside, *shelved], key=lambda entry: entry[0])

    @rule()
    def retry(self) -> None:
        kept = [(r, k, payload) for _, r, k, payload, _ in self.aside if payload is not None]
        assert self.spool.retry_refused() == len(kept)
        self.aside = [entry for entry in self.aside if entry[3] is None]
        for run_id, keyframe_id, payload in kept:
            self.last_seq += 1
            self.waiting.append((self.last_seq, run_id, keyframe_id, payload))

    @rule()
    def discard(self) -> None:
        assert self.spool.discard_refused() == len(self.aside)
        self.aside = []

    @rule(data=st.data())
    def acknowledge(self, data: st.DataObject) -> None:
        """Of payloads that wait, are set aside, or are unknown here."""
        known = [entry[3] for entry in [*self.waiting, *self.aside] if entry[3] is not None]
        payloads = data.draw(
            st.lists(st.one_of(st.sampled_from([b"x", *known]), st.binary(max_size=3)), min_size=1)
        )
        digests = tuple(map(payload_sha256, payloads))
        ack = Ack(run_id="run-a", key="tb/detections", log_id="log", sha256=digests)
        kept = [entry for entry in self.waiting if entry[3] not in payloads]
        assert self.spool.acknowledge(ack) == len(self.waiting) - len(kept)
        self.waiting = kept
        self.aside = [entry for entry in self.aside if entry[4] not in digests]

    @rule(seq=st.integers(0, 30), limit=st.integers(0, 5))
    def look(self, seq: int, limit: int) -> None:
        after = [Spooled(*entry) for entry in self.waiting if entry[0] > seq]
        assert self.spool.after(seq, limit) == after[:limit]
        assert self.spool.waiting_up_to(seq) == len(self.waiting) - len(after)

    @rule()
    def reopen(self) -> None:
        self.spool.close()
        self.spool = self._open()

    @invariant()
    def counts_what_waits(self) -> None:
        assert len(self.spool) == len(self.waiting)
        assert self.spool.oldest() == min((entry[0] for entry in self.waiting), default=None)
        assert self.spool.refused_count == len(self.aside)
        assert self.spool.refused(100) == [
            Refused(run_id, keyframe_id, "log", "too blue")
            for _, run_id, keyframe_id, *_ in self.aside
        ]

    def teardown(self) -> None:
        self.spool.close()
        shutil.rmtree(self.folder)


TestSpool = SpoolMachine.TestCase
TestSpool.settings = settings(max_examples=examples(30), stateful_step_count=30, deadline=None)
