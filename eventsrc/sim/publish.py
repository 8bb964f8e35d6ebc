"""Where a simulated run goes: over Zenoh in scaled real time, or into a file, the truth beside."""

import gzip
import threading
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from eventsrc._zenoh import Session
from eventsrc.errors import MisuseError, TransportError

from .run import SimulatedRun, encode


def publish_run(
    session: Session,
    run: SimulatedRun,
    key: str,
    *,
    speed: float,
    wait_s: float,
    stop: threading.Event,
) -> int:
    """Publish ``run`` under ``key``, ``speed`` times as fast as the robot drove; 0 is unpaced.

    Waits up to ``wait_s`` seconds for a subscriber, because a message without one is gone. Returns
    how many keyframes were sent; fewer than the run has when ``stop`` was set.
    """
    publisher = session.publisher(key)
    if not publisher.wait_for_subscriber(wait_s):
        raise TransportError(
            f"nobody subscribed to {key!r} within {wait_s:g} s; start `mapfold record LOG` first "
            "or wait longer with --wait"
        )
    sent = 0
    started = time.monotonic()
    for payload, pose in zip(run.payloads, run.true_poses, strict=True):
        due = started + pose.time_s / speed if speed > 0 else started
        if stop.wait(max(0.0, due - time.monotonic())):
            break
        publisher.put(payload)
        sent += 1
    session.confirm()
    publisher.close()
    return sent


def write_run(run: SimulatedRun, out: Path) -> Path:
    """Write ``run`` as JSON lines to ``out`` (gzip if it ends in .gz); returns the truth's path."""
    truth = truth_path(out)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        _write_lines(out, run.envelopes)
        _write_lines(truth, run.truth)
    except OSError as error:
        raise MisuseError(
            f"{out}: cannot be written: {error.strerror}; choose another --out"
        ) from None
    return truth


def truth_path(out: Path) -> Path:
    """Where the truth of ``out`` goes: run.jsonl.gz has run.truth.jsonl.gz beside it."""
    stem = out.name.removesuffix(".gz").removesuffix(".jsonl")
    return out.with_name(f"{stem}.truth{out.name.removeprefix(stem)}")


def _write_lines(path: Path, documents: Iterable[dict[str, Any]]) -> None:
    text = b"".join(encode(document) + b"\n" for document in documents)
    if path.suffix == ".gz":  # no name and no time inside: the same run gives the same file
        text = gzip.compress(text, mtime=0)
    path.write_bytes(text)
