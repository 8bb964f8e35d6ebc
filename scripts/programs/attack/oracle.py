"""Sent and acknowledged payloads, kept outside of the attacked processes."""

import hashlib
import threading
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from eventsrc.envelope.system_events import is_system_key
from eventsrc.log import LogReader
from eventsrc.log.segment import Unreadable


def digest(payload: bytes) -> bytes:
    """The SHA-256 that names a payload."""
    return hashlib.sha256(payload).digest()


@dataclass(frozen=True, slots=True)
class Judgement:
    """Acknowledged events that the log lacks, and events in it that were never sent or that have
    another offset than before."""

    acknowledged: int
    lost: int
    invented: int


class Oracle:
    """Digests of payloads: sent, acknowledged, and seen at which offset. For many threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._sent: set[bytes] = set()
        self._acknowledged: set[bytes] = set()
        self._at: dict[int, bytes] = {}
        self.destroyed: set[bytes] = set()
        """Acknowledged payloads that the attack itself removed from the disk."""

    def sent(self, payload: bytes) -> None:
        """Note a payload that is about to be sent."""
        with self._lock:
            self._sent.add(digest(payload))

    def acknowledged(self, digests: Iterable[bytes]) -> None:
        """Note payloads that a recorder has acknowledged."""
        with self._lock:
            self._acknowledged.update(digests)

    def wrote(self, offset: int, payload: bytes) -> None:
        """Note a payload that is synced at ``offset``."""
        with self._lock:
            self._sent.add(digest(payload))
            self._acknowledged.add(digest(payload))
            self._at[offset] = digest(payload)

    def forget_promises(self) -> None:
        """The attack destroyed unknown events: any may be missing from now on, but none may be
        invented or change its offset."""
        with self._lock:
            self.destroyed |= self._acknowledged

    def judge(self, log: Path) -> Judgement:
        """Read all of ``log`` that can be read, and compare."""
        found: set[bytes] = set()
        invented = 0
        gaps: list[Unreadable] = []
        with LogReader(log) as reader, self._lock:
            for event in reader.read(on_gap=gaps.append):
                if is_system_key(event.key):
                    continue
                name = digest(event.payload)
                found.add(name)
                if name not in self._sent or self._at.setdefault(event.offset, name) != name:
                    invented += 1
            lost = self._acknowledged - found - self.destroyed
            return Judgement(len(self._acknowledged), len(lost), invented)
