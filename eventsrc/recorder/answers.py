"""What robots are to hear of an event, once it is synced: an ack, a refusal, or nothing."""

from collections import defaultdict
from collections.abc import Iterator
from typing import NamedTuple

from eventsrc._zenoh import Received
from eventsrc.acks import Ack, ack_key
from eventsrc.append import Judged
from eventsrc.envelope import ENVELOPE_VERSION
from eventsrc.ingest import Rejected
from eventsrc.losses import GapLedger
from eventsrc.refusals import Refusal, Refusals, refusal_key


class Unsynced(NamedTuple):
    """What follows from an event once it is synced. ``run_id`` is None for what counts no
    keyframes: a rejected payload, or a form older than the envelope. ``refusal`` is what to say
    of a rejected payload, ``key`` what it came under."""

    offset: int
    key: str
    refusal: Refusal | None
    run_id: str | None
    keyframe_id: int


def unsynced(offset: int, message: Received, judged: Judged) -> Unsynced:
    """What follows from ``message``, which gets into the log at ``offset``."""
    event, verdict = judged
    key = message.key
    if isinstance(verdict, Rejected):
        return Unsynced(offset, key, Refusal.of(message.payload, verdict.reason), None, 0)
    if event.version != ENVELOPE_VERSION:
        return Unsynced(offset, key, None, None, 0)
    return Unsynced(offset, key, None, verdict.run_id, verdict.keyframe_id)


class Answers:
    """The answers to what one sync made durable: `note` each event, then send `messages`."""

    def __init__(self) -> None:
        self._keyframes: defaultdict[str, list[int]] = defaultdict(list)
        self._refusals: defaultdict[str, list[Refusal]] = defaultdict(list)

    def note(self, event: Unsynced) -> None:
        """``event`` is synced."""
        if event.run_id is not None:
            self._keyframes[event.run_id].append(event.keyframe_id)
        if event.refusal is not None:
            self._refusals[event.key].append(event.refusal)

    def messages(self, log_id: str, ledger: GapLedger) -> Iterator[tuple[str, bytes]]:
        """Key and payload of each; ``ledger`` knows everything that was noted."""
        for run_id, keyframe_ids in self._keyframes.items():
            stretches = _stretches(ledger, run_id, keyframe_ids)
            yield ack_key(run_id), Ack(run_id=run_id, log_id=log_id, stretches=stretches).encode()
        for key, refused in self._refusals.items():
            yield refusal_key(key), Refusals(log_id=log_id, refused=tuple(refused)).encode()


def _stretches(
    ledger: GapLedger, run_id: str, keyframe_ids: list[int]
) -> tuple[tuple[int, int], ...]:
    """The recorded stretches these keyframes lie in, in order, each once."""
    found: list[tuple[int, int]] = []
    for keyframe_id in sorted(keyframe_ids):
        if found and keyframe_id <= found[-1][1]:
            continue
        stretch = ledger.stretch(run_id, keyframe_id)
        if stretch is not None:
            found.append(stretch)
    return tuple(found)
