"""What a recorder tells robots: these keyframes of yours are on disk.

An ack goes out on ``mapfold/ack/<run_id>`` after a sync and names the stretches of the run around
every keyframe received since the ack before; so whatever a robot sends, or sends again, is covered
by the next ack it gets. It is no event: it is not in the log, and a lost one is made good by the
next.
"""

from typing import Annotated, Final
from urllib.parse import quote

from pydantic import BaseModel, ConfigDict, Field

ACK_PREFIX: Final = "mapfold/ack/"


def ack_key(run_id: str) -> str:
    """The key of the acks for ``run_id``, which may hold what a key expression may not."""
    return ACK_PREFIX + quote(run_id, safe="")


class Ack(BaseModel):
    """Every keyframe of ``stretches`` (first and last, both included) is synced in ``log_id``."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    run_id: str
    log_id: str
    stretches: Annotated[tuple[tuple[int, int], ...], Field(min_length=1)]

    def encode(self) -> bytes:
        """The bytes that go over the wire."""
        return self.model_dump_json().encode()

    @classmethod
    def decode(cls, payload: bytes) -> "Ack":
        """Back from bytes; raises ValidationError for anything that is no ack."""
        return cls.model_validate_json(payload)

    def covers(self, keyframe_id: int) -> bool:
        """Whether this keyframe is among them."""
        return any(first <= keyframe_id <= last for first, last in self.stretches)
