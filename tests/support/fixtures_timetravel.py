"""Logs for the time travel tests: walks through a small building, written as real logs."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

from eventsrc.log import LogWriter, parse_fsync
from eventsrc.record.append import append_payload
from tests.support.envelopes import detection, envelope, payload

VECTORS = {"cup": [1.0, 0.0, 0.1, 0.0], "chair": [0.0, 1.0, 0.0, 0.1], "lamp": [0.3, 0.0, 1.0, 0.0]}


NOT_AN_ENVELOPE = {"nothing": "a robot would send"}
"""An invalid payload: it is logged as rejected and changes nothing."""


def write_log(path: Path, documents: Iterable[dict[str, Any]]) -> Path:
    """A log of these envelopes, in this order."""
    with LogWriter(path, fsync=parse_fsync("never")) as writer:
        for document in documents:
            append_payload(writer, "tb/detections", payload(document))
    return path


def write_damaged_log(path: Path, documents: Iterable[dict[str, Any]]) -> Path:
    """The same, and at its end an event under a robot's key that cannot be folded."""
    write_log(path, documents)
    with LogWriter(path) as writer:
        writer.append("tb/detections", b"not an envelope", stamp_ns=0)
    return path


@st.composite
def walks(draw: st.DrawFn, most: int = 40) -> list[dict[str, Any]]:
    """Envelopes of two runs that jump about in a corridor, so that places form apart and merge;
    with keyframes out of order, repeated, without a pose, refused, and look-alike objects."""
    count = draw(st.sampled_from([0, 1, most // 4, most // 2, most, most]))
    steps = draw(st.permutations([(n % 10, n % 13 // 12) for n in range(count)]))
    documents: list[dict[str, Any]] = []
    for number, (x, y) in enumerate(steps):
        if draw(st.integers(0, 19)) == 0:
            documents.append(NOT_AN_ENVELOPE)
            continue
        run = draw(st.sampled_from(["run-a", "run-a", "run-b"]))
        late = draw(st.integers(0, 9)) == 0
        keyframe = max(0, number - draw(st.integers(1, 3))) if late else 2 * number
        seen = [
            detection(name, VECTORS[name], det_id=f"{run}-{keyframe}-{number}-{i}")
            for i, name in enumerate(draw(st.lists(st.sampled_from(list(VECTORS)), max_size=2)))
        ]
        posed = draw(st.integers(0, 9)) > 0
        documents.append(
            envelope(
                keyframe,
                0.7 * x if posed else None,
                1.1 * y,
                run_id=run,
                detections=seen,
            )
        )
    return documents
