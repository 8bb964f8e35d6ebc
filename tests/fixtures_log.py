"""Logs, envelopes and small helpers for the tests of the log."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from eventsrc.log import Event, FsyncPolicy, LogReader, LogWriter

BY_HAND = FsyncPolicy(interval_ns=10**18, max_events=10**9, max_bytes=10**12)
"""Commits only when told to, so that a test decides where chunks end."""

KEY = "tb/detections"


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


def read_log(path: Path, start: int = 0, end: int | None = None) -> list[Event]:
    """All durable events."""
    with LogReader(path) as reader:
        return list(reader.read(start, end))


@pytest.fixture
def log_path(tmp_path: Path) -> Path:
    """Where a test's log may be made."""
    return tmp_path / "log"
