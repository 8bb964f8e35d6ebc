"""What a recorder tells robots of payloads it will never acknowledge.

A refused payload may have no run that can be read, so it is named by its size and SHA-256, and the
refusals go out by the key it came under, on ``mapfold/ack/refused/<key>``: two parts behind the
prefix, so no run's ack key, and behind that prefix because recorders of ``**`` pass over whatever
is there. A refusal is sent when the ``mapfold/rejected`` event with the bytes and the reason is
synced. It is no event itself: whoever missed it sends again and hears the next.
"""

import hashlib
from typing import Annotated, Final
from urllib.parse import quote

from pydantic import BaseModel, ConfigDict, Field

from .acks import ACK_PREFIX
from .keys import MAX_KEY_BYTES

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
