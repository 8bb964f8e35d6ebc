"""What `mapfold log verify` may find."""

from dataclasses import dataclass
from typing import Literal

Kind = Literal["crc", "gap", "chain", "log_id", "torn", "schema", "duplicate", "time", "loss"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is not as it should be.

    ``first_offset`` and ``last_offset`` are the first and last event it concerns, None where it
    concerns none; ``count`` is how many.

    crc        bytes differ from what was written
    gap        events that were recorded are not there
    chain      a segment is not the one its successor was written after
    log_id     a segment belongs to another log
    torn       an end that was being written when its writer died; never recorded
    schema     an event the fold cannot read
    duplicate  a keyframe that stands more than once (the fold takes the first)
    time       a clock that ran backwards, or was set while a robot drove
    loss       what the log says never came and did not come late either, or was lost to rot
    """

    kind: Kind
    message: str
    segment: str | None = None
    first_offset: int | None = None
    last_offset: int | None = None
    count: int = 1
