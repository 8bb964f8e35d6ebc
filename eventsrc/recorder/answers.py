"""What robots are to hear of an event, once it is synced: an ack, a refusal, or nothing."""

from collections import defaultdict
from collections.abc import Iterator
from typing import NamedTuple

from eventsrc._zenoh import Received
from eventsrc.acks import MOST_PER_ACK, Ack, ack_key
from eventsrc.append import Judged
from eventsrc.envelope import ENVELOPE_VERSION
from eventsrc.ingest import Rejected
from eventsrc.refusals import Refusal, Refusals, fingerprint, refusal_key


class Unsynced(NamedTuple):
    """What follows from an event once it is synced. ``run_id`` is None for what counts no
    keyframes: a rejected payload, or a form older than the envelope. ``refusal`` is what to say
    of a rejected payload, ``key`` what it came under, ``sha256`` names the bytes of an envelope."""

    offset: int
    key: str
    refusal: Refusal | None
    run_id: str | None
    keyframe_id: int
    sha256: str


def unsynced(offset: int, message: Received, judged: Judged) -> Unsynced:
    """What follows from ``message``, which gets into the log at ``offset``."""
    event, verdict = judged
    key = message.key
    if isinstance(verdict, Rejected):
        return Unsynced(offset, key, Refusal.of(message.payload, verdict.reason), None, 0, "")
    if event.version != ENVELOPE_VERSION:
        return Unsynced(offset, key, None, None, 0, "")
    digest = fingerprint(message.payload)
    return Unsynced(offset, key, None, verdict.run_id, verdict.keyframe_id, digest)


class Answers:
    """The answers to what one sync made durable: `note` each event, then send `messages`."""

    def __init__(self) -> None:
        self._synced: defaultdict[tuple[str, str], list[str]] = defaultdict(list)
        self._refusals: defaultdict[str, list[Refusal]] = defaultdict(list)

    def note(self, event: Unsynced) -> None:
        """``event`` is synced."""
        if event.run_id is not None:
            self._synced[event.run_id, event.key].append(event.sha256)
        if event.refusal is not None:
            self._refusals[event.key].append(event.refusal)

    def messages(self, log_id: str) -> Iterator[tuple[str, bytes]]:
        """Key and payload of each."""
        for (run_id, key), digests in self._synced.items():
            for start in range(0, len(digests), MOST_PER_ACK):
                some = tuple(digests[start : start + MOST_PER_ACK])
                ack = Ack(run_id=run_id, key=key, log_id=log_id, sha256=some)
                yield ack_key(run_id), ack.encode()
        for key, refused in self._refusals.items():
            yield refusal_key(key), Refusals(log_id=log_id, refused=tuple(refused)).encode()
