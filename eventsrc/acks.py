"""What a recorder tells robots: these envelopes of yours are on disk.

An ack goes out on ``mapfold/ack/<run_id>`` after a sync and names the SHA-256 of every payload of
that run which this sync has put on the disk, and the key they came under. So it can be wrong about
nobody's envelopes, whatever run, keyframe or sender a message claims: who has the same bytes under
the same key has them in the log. It is no event: it is not in the log, and a robot that has not
heard it sends again and hears the next.
"""

from typing import Annotated, Final
from urllib.parse import quote

from pydantic import BaseModel, ConfigDict, FailFast, Field

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
