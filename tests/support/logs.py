"""Small logs for tests, written as the recorder writes them."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from eventsrc.log import NEVER, LogWriter
from eventsrc.record.append import append_payload
from tests.support.envelopes import detection, envelope, payload

KEY = "tb/detections"
WEIRD = (
    "baker's rack",
    "x'}) DETACH DELETE r //",
    "$$; drop table",
    "☕ 🤖",
    '\\ "q" \\n \\',
    "}{[]",
)


def write_log(path: Path, documents: Iterable[Any], *, key: str = KEY) -> Path:
    """Append ``documents`` (envelopes as dictionaries) to the log; logged at 1, 2 … s."""
    with LogWriter(path, fsync=NEVER) as writer:
        for document in documents:
            logged_ns = (writer.next_offset + 1) * 1_000_000_000 + 123_456_789
            append_payload(writer, key, payload(document), logged_ns=logged_ns)
    return path


def append_raw(path: Path, data: bytes, *, key: str = KEY) -> None:
    """Append bytes as they are: what a writer other than ours might have put there."""
    with LogWriter(path, fsync=NEVER) as writer:
        writer.append(key, data)


def walk(
    count: int,
    *,
    seed: int = 0,
    run_id: str = "run-a",
    first: int = 0,
    detections: int = 2,
    dim: int = 8,
    rooms: int = 3,
) -> list[dict[str, Any]]:
    """A robot that wanders between rooms 6 m apart, noise between them, with odd class names."""
    rng = np.random.default_rng(seed)
    classes = [rng.normal(size=dim) for _ in WEIRD]
    documents = []
    for k in range(first, first + count):
        room = int(rng.integers(rooms))
        stray = rng.random() < 0.15
        x = 6.0 * room + (3.0 if stray else 0.0) + float(rng.normal()) * (0.2 if stray else 0.6)
        seen = []
        for _ in range(int(rng.integers(detections + 1))):
            c = int(rng.integers(len(WEIRD)))
            vector = None if rng.random() < 0.1 else classes[c] + 0.3 * rng.normal(size=dim)
            seen.append(detection(WEIRD[c], vector))
        lost = rng.random() < 0.1
        documents.append(
            envelope(
                k,
                None if lost else x,
                None if lost else float(rng.normal()),
                run_id=run_id,
                detections=seen,
            )
        )
    return documents


def bridge(run_id: str = "run-b", first: int = 0) -> Sequence[dict[str, Any]]:
    """Keyframes that join every room of `walk` into one place."""
    return [envelope(first + i, i * 0.7, 0.0, run_id=run_id) for i in range(20)]
