"""Messages between recorders and robots: acknowledgements, refusals, progress. None is an event.

* An `Ack` goes out on ``mapfold/ack/<run_id>`` after a sync. It names the key and the SHA-256 of
  every payload of that run that the sync has brought to the disk. It names bytes, not keyframes, so
  no other run, keyframe or sender can be acknowledged by mistake. A robot that missed it sends
  again and gets the next.
* `Refusals` name payloads that a recorder will never acknowledge, by size and SHA-256, since such a
  payload may have no readable run. They go out on ``mapfold/ack/refused/<key>``, when the
  ``mapfold/rejected`` event with the bytes and the reason is synced. That key has two parts behind
  the ack prefix, so it is no run's ack key, and recorders of ``**`` ignore everything behind that
  prefix. A robot that missed it sends again and gets the next.
* `Sent` is a robot's progress: the last keyframe of a run that it has sent. Without it, a recorder
  could not find that the last keyframes of a run are missing: a gap shows only when a later
  keyframe is recorded. It goes out on ``<key>/@mapfold/sent``. No ``*`` or ``**`` matches that, so
  only subscribers that name ``@mapfold`` receive it. A gap found by it is an event
  (`eventsrc.envelope.gaps`).
"""

import hashlib
from typing import Annotated, Final, Self
from urllib.parse import quote

from pydantic import BaseModel, ConfigDict, FailFast, Field

from eventsrc.envelope.model import RunId
from eventsrc.record.transport.config import MAX_KEY_BYTES

ACK_PREFIX: Final = "mapfold/ack/"
_REFUSAL_PREFIX: Final = f"{ACK_PREFIX}refused/"
SENT_SUFFIX: Final = "/@mapfold/sent"
MAX_PER_ACK: Final = 512
"""Payloads named by one ack: 34 kB, which Zenoh sends in one piece."""
MAX_SENT_BYTES: Final = 4_096
"""Bound of an encoded `Sent`, more than any run id takes."""


def payload_sha256(payload: bytes) -> str:
    """The SHA-256 that names a payload, in hexadecimal."""
    return hashlib.sha256(payload).hexdigest()


def ack_key(run_id: RunId) -> str:
    """The key of the acks for ``run_id``; characters not allowed in a key are quoted."""
    return ACK_PREFIX + quote(run_id, safe="")


class WireMessage(BaseModel):
    """A message that goes over the wire as JSON."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    def encode(self) -> bytes:
        """The bytes that go over the wire."""
        return self.model_dump_json().encode()

    @classmethod
    def decode(cls, payload: bytes) -> Self:
        """From bytes; raises ValidationError for anything else."""
        return cls.model_validate_json(payload)


class Ack(WireMessage):
    """Every payload of ``sha256`` came under ``key`` and is synced in ``log_id``."""

    run_id: RunId
    key: str
    log_id: str
    sha256: Annotated[tuple[str, ...], Field(min_length=1), FailFast()]


def refusal_key(key: str) -> str:
    """The key of the refusals of payloads that came under ``key``.

    A key that is too long for envelopes is replaced by ``=`` and its SHA-256. `quote` leaves no
    ``=``, so the two forms cannot collide.
    """
    raw = key.encode()
    if len(raw) > MAX_KEY_BYTES:
        return f"{_REFUSAL_PREFIX}={hashlib.sha256(raw).hexdigest()}"
    return _REFUSAL_PREFIX + quote(key, safe="")


class Refusal(WireMessage):
    """One payload, ``size`` bytes long, and why it was refused."""

    sha256: str
    size: int
    reason: str

    @classmethod
    def of(cls, payload: bytes, reason: str) -> "Refusal":
        """The refusal of ``payload``."""
        return cls(sha256=payload_sha256(payload), size=len(payload), reason=reason)


class Refusals(WireMessage):
    """The bytes and the reason of every payload in ``refused`` are synced in ``log_id``."""

    log_id: str
    refused: Annotated[tuple[Refusal, ...], Field(min_length=1)]


def sent_key(key: str) -> str:
    """The key of the `Sent` messages about ``key``; both may be key expressions."""
    return key + SENT_SUFFIX


class Sent(WireMessage):
    """Keyframe ``last`` of ``run_id`` was sent."""

    model_config = ConfigDict(strict=True)

    run_id: RunId
    last: Annotated[int, Field(ge=-(2**63), lt=2**63)]
