"""What is kept of an event that could not be folded."""

import json

from eventsrc.log import Event
from projections.sinks._checkpoint import DeadLetter


def dead_letter(event: Event, reason: str) -> DeadLetter:
    """Where it stands in the log, why it was left out, and its run if the payload still tells."""
    return DeadLetter(event.offset, event.key, _run_id(event.payload), reason)


def _run_id(payload: bytes) -> str | None:
    try:
        document = json.loads(payload)
    except (ValueError, RecursionError):
        return None
    run_id = document.get("run_id") if isinstance(document, dict) else None
    return run_id if isinstance(run_id, str) and "\0" not in run_id else None
