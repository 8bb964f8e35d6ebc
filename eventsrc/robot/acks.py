"""What a recorder tells robots: these envelopes of yours are on disk.

An ack goes out on ``mapfold/ack/<run_id>`` after a sync and names the SHA-256 of every payload of
that run which this sync has put on the disk, and the key they came under. So it can be wrong about
nobody's envelopes, whatever run, keyframe or sender a message claims: who has the same bytes under
the same key has them in the log. It is no event: it is not in the log, and a robot that has not
heard it sends again and hears the next.

What a recorder tells robots of payloads it will never acknowledge.

A refused payload may have no run that can be read, so it is named by its size and SHA-256, and the
refusals go out by the key it came under, on ``mapfold/ack/refused/<key>``: two parts behind the
prefix, so no run's ack key, and behind that prefix because recorders of ``**`` pass over whatever
is there. A refusal is sent when the ``mapfold/rejected`` event with the bytes and the reason is
synced. It is no event itself: whoever missed it sends again and hears the next.

What a robot tells recorders: how far it has got with a run.

Without it, nobody could miss the last keyframes of a run: a gap shows when a keyframe behind it is
recorded. It goes out on ``<key>/@mapfold/sent``, which no ``*`` or ``**`` matches, so that nobody
receives it who does not ask for it. It is no event and is not in the log; what follows from it, a
gap, is (`eventsrc.gaps`).
"""

import hashlib
from typing import Annotated, Final
from urllib.parse import quote

from pydantic import BaseModel, ConfigDict, FailFast, Field

from eventsrc.transport.config import MAX_KEY_BYTES

ACK_PREFIX: Final = "mapfold/ack/"
MOST_PER_ACK: Final = 512
"""Payloads one ack names: 34 kB, which Zenoh sends in one piece."""


def ack_key(run_id: str) -> str:
    """The key of the acks for ``run_id``, which may hold what a key expression may not."""
    return ACK_PREFIX + quote(run_id, safe="")


class Ack(BaseModel):
    """Every payload of ``sha256`` came under ``key`` and is synced in ``log_id``."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    run_id: str
    key: str
    log_id: str
    sha256: Annotated[tuple[str, ...], Field(min_length=1), FailFast()]

    def encode(self) -> bytes:
        """The bytes that go over the wire."""
        return self.model_dump_json().encode()

    @classmethod
    def decode(cls, payload: bytes) -> "Ack":
        """Back from bytes; raises ValidationError for anything that is no ack."""
        return cls.model_validate_json(payload)


_PREFIX: Final = f"{ACK_PREFIX}refused/"


def refusal_key(key: str) -> str:
    """The key of the refusals of what came under ``key``. One that is too long for an envelope is
    named by its digest behind a ``=``, which `quote` leaves in nothing; else it would be longer."""
    raw = key.encode()
    if len(raw) > MAX_KEY_BYTES:
        return f"{_PREFIX}={hashlib.sha256(raw).hexdigest()}"
    return _PREFIX + quote(key, safe="")


def fingerprint(payload: bytes) -> str:
    """What names these bytes: their SHA-256, in hexadecimal."""
    return hashlib.sha256(payload).hexdigest()


class Refusal(BaseModel):
    """One payload, ``size`` bytes long, and why it was refused."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    sha256: str
    size: int
    reason: str

    @classmethod
    def of(cls, payload: bytes, reason: str) -> "Refusal":
        """Say that ``payload`` was refused for ``reason``."""
        return cls(sha256=fingerprint(payload), size=len(payload), reason=reason)


class Refusals(BaseModel):
    """The bytes and the reason of every payload in ``refused`` are synced in ``log_id``."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    log_id: str
    refused: Annotated[tuple[Refusal, ...], Field(min_length=1)]

    def encode(self) -> bytes:
        """The bytes that go over the wire."""
        return self.model_dump_json().encode()

    @classmethod
    def decode(cls, payload: bytes) -> "Refusals":
        """Back from bytes; raises ValidationError for anything else."""
        return cls.model_validate_json(payload)


SENT_SUFFIX: Final = "/@mapfold/sent"
MAX_SENT_BYTES: Final = 4_096
"""More than any run id takes."""


def sent_key(key: str) -> str:
    """Where it is told of what goes out under ``key``; both may be key expressions."""
    return key + SENT_SUFFIX


class Sent(BaseModel):
    """Keyframe ``last`` of ``run_id`` was sent."""

    model_config = ConfigDict(frozen=True, extra="ignore", strict=True)

    run_id: str
    last: Annotated[int, Field(ge=-(2**63), lt=2**63)]

    def encode(self) -> bytes:
        """The bytes that go over the wire."""
        return self.model_dump_json().encode()

    @classmethod
    def decode(cls, payload: bytes) -> "Sent":
        """Back from bytes; raises ValidationError for anything else."""
        return cls.model_validate_json(payload)
