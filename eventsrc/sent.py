"""What a robot tells recorders: how far it has got with a run.

Without it, nobody could miss the last keyframes of a run: a gap shows when a keyframe behind it is
recorded. It goes out on ``<key>/@mapfold/sent``, which no ``*`` or ``**`` matches, so that nobody
receives it who does not ask for it. It is no event and is not in the log; what follows from it, a
gap, is (`eventsrc.losses`).
"""

from typing import Annotated, Final

from pydantic import BaseModel, ConfigDict, Field

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
