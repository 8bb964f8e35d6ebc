"""Logs, envelopes and small helpers for the tests of the log."""

import json
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from eventsrc.log import Event, FsyncPolicy, LogReader, LogWriter

BY_HAND = FsyncPolicy(interval_ns=10**18, max_events=10**9, max_bytes=10**12)
"""Commits only when told to, so that a test decides where chunks end."""

KEY = "tb/detections"

MEMORY_DISK = Path("/dev/shm")


def envelope(keyframe_id: int, run_id: str = "run", **more: Any) -> bytes:
    """A small valid envelope."""
    return json.dumps(
        {
            "run_id": run_id,
            "keyframe_id": keyframe_id,
            "timestamp": 1000.0 + keyframe_id,
            "map_x": 0.5 * keyframe_id,
            "map_y": 0.0,
            "map_yaw": 0.0,
            "detections": [],
            **more,
        }
    ).encode()


def write_log(path: Path, payloads: Sequence[bytes], **options: Any) -> None:
    """A closed log of ``payloads``; event i is stamped i and was logged at 1000 + i."""
    with LogWriter(path, **options) as writer:
        for index, payload in enumerate(payloads):
            writer.append(KEY, payload, stamp_ns=index, logged_ns=1000 + index)


def flip(path: Path, at: int) -> None:
    """One bit of a file rots."""
    data = bytearray(path.read_bytes())
    data[at] ^= 1
    path.write_bytes(data)


def read_log(path: Path, start: int = 0, end: int | None = None) -> list[Event]:
    """All durable events."""
    with LogReader(path) as reader:
        return list(reader.read(start, end))


def read_with_gaps(path: Path) -> tuple[list[Event], set[int]]:
    """All that can be read, and the offsets named as unreadable."""
    named: set[int] = set()
    with LogReader(path) as reader:
        shown = list(reader.read(on_gap=lambda gap: named.update(range(gap.first, gap.last + 1))))
    return shown, named


@pytest.fixture
def quick_path() -> Iterator[Path]:
    """A folder in memory where there is one, for tests that sync tens of thousands of times."""
    base = MEMORY_DISK if MEMORY_DISK.is_dir() else None
    with tempfile.TemporaryDirectory(dir=base) as name:
        yield Path(name)


@pytest.fixture
def log_path(tmp_path: Path) -> Path:
    """Where a test's log may be made."""
    return tmp_path / "log"
