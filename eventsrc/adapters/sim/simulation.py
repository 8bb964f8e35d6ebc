"""Simulate a run through a house, and publish it over Zenoh or write it to a file.

The poses in the envelopes are those of a localisation, a centimetre or two off the true ones. The
truth, the room of each keyframe and the instance of each detection, is written to a file of its
own, never into an envelope or a log.
"""

import gzip
import json
import threading
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from eventsrc.base.advised import advised
from eventsrc.base.errors import MisuseError, TransportError
from eventsrc.base.output_files import write_files
from eventsrc.base.progress import reported
from eventsrc.envelope.model import KeyframeId, RunId, default_det_id
from eventsrc.record.transport.session import Session

from .detector import detect, visible_objects
from .floorplan import wrap
from .house import House, build_house
from .random_streams import normal, stream
from .tour import EXPLORER, TruePose, drive, keyframes, plan_tour

DEFAULT_SEED = 7
FIRST_START_S = 1_777_885_200.0
"""The start of run a, 2026-05-04 09:00 UTC. Each further run starts a day later."""
_DAY_S = 86_400.0
_POSITION_NOISE_M = 0.012
_YAW_NOISE_RAD = 0.008


@dataclass(frozen=True, slots=True)
class SimulatedRun:
    """A whole run. ``envelopes``, ``truth`` and ``true_poses`` run parallel, one per keyframe."""

    run_id: RunId
    house: House
    envelopes: tuple[dict[str, Any], ...]
    truth: tuple[dict[str, Any], ...]
    true_poses: tuple[TruePose, ...]

    @property
    def payloads(self) -> Iterator[bytes]:
        """The envelopes as the bytes that go over Zenoh."""
        return (encode(envelope) for envelope in self.envelopes)


def encode(document: dict[str, Any]) -> bytes:
    """One compact line of UTF-8 JSON, without a line end."""
    return json.dumps(document, ensure_ascii=False, separators=(",", ":")).encode()


def simulate_run(seed: int = DEFAULT_SEED, run: str = EXPLORER) -> SimulatedRun:
    """Simulate ``run`` through house ``seed``. Run ``a`` explores; each other name is a session."""
    house, run_id = build_house(seed), RunId(f"sim-{seed}-{run}")
    poses = tuple(keyframes(drive(house.grid, plan_tour(house, run))))
    start_s = start_of(run)
    watched = reported(poses, "simulating", len(poses), "keyframes")
    made = [
        _keyframe(house, run_id, number, pose, start_s)
        for number, pose in enumerate(watched, start=1)
    ]
    return SimulatedRun(
        run_id, house, tuple(envelope for envelope, _ in made), tuple(t for _, t in made), poses
    )


def start_of(run: str) -> float:
    """The start of ``run`` in seconds since the Unix epoch."""
    return FIRST_START_S + _DAY_S * _day(run)


def _day(run: str) -> int:
    """Runs a, b, c … are on successive days; the day of a longer name is drawn from its text."""
    if len(run) == 1 and "a" <= run <= "z":
        return ord(run) - ord("a")
    return 26 + int(stream("day", run).integers(0, 1000))


def _keyframe(
    house: House, run_id: RunId, number: int, pose: TruePose, start_s: float
) -> tuple[dict[str, Any], dict[str, Any]]:
    rng = stream("keyframe", run_id, number)
    detections = list(detect(visible_objects(house, pose), run_id, rng))
    envelope = {
        "run_id": run_id,
        "keyframe_id": number,
        "timestamp": round(start_s + pose.time_s, 3),
        **noisy_pose(pose, rng),
        "detections": [
            {"det_id": default_det_id(run_id, KeyframeId(number), index), **detection.fields}
            for index, detection in enumerate(detections)
        ],
    }
    truth = {
        "run_id": run_id,
        "keyframe_id": number,
        "room": house.plan.room_at(pose.x, pose.y),
        "instances": [detection.instance for detection in detections],
    }
    return envelope, truth


def noisy_pose(pose: TruePose, rng: np.random.Generator) -> dict[str, float]:
    """The pose of a localisation, a centimetre or two off the true one."""
    return {
        "map_x": round(pose.x + _POSITION_NOISE_M * normal(rng), 4),
        "map_y": round(pose.y + _POSITION_NOISE_M * normal(rng), 4),
        "map_yaw": round(wrap(pose.yaw_rad + _YAW_NOISE_RAD * normal(rng)), 4),
    }


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

    Waits up to ``wait_s`` seconds for a subscriber, because messages without one are lost; raises
    TransportError if there is none. Returns the number of keyframes sent before ``stop`` was set.
    """
    publisher = session.publisher(key)
    if not publisher.wait_for_subscriber(wait_s):
        raise TransportError(
            f"no one subscribed to {key!r} within {wait_s:g} s; start `{advised('record')}` first "
            "or wait longer with --wait"
        )
    sent = 0
    started = time.monotonic()
    count = len(run.envelopes)
    watched = reported(run.payloads, "publishing", count, "keyframes")
    for payload, pose in zip(watched, run.true_poses, strict=True):
        due = started + pose.time_s / speed if speed > 0 else started
        if stop.wait(max(0.0, due - time.monotonic())):
            break
        publisher.put(payload)
        sent += 1
    session.confirm()
    publisher.close()
    return sent


def write_run(run: SimulatedRun, out: Path) -> Path:
    """Write ``run`` as JSON lines to ``out`` (gzip if it ends in .gz); returns the truth's path.

    A file that is there stays as it is, since it may be a recorded run: it must hold the same bytes
    already. Raises MisuseError where it holds others or no file can be made, MapfoldError where
    writing it fails.
    """
    truth = truth_path(out)
    contents = {out: _lines(out, run.envelopes), truth: _lines(truth, run.truth)}
    missing = {path: text for path, text in contents.items() if not _holds(path, text)}
    write_files(missing)
    return truth


def _holds(path: Path, text: bytes) -> bool:
    """Whether ``path`` is a file of these bytes; raises MisuseError if it is one of others."""
    if not path.is_file() or path.is_relative_to("/dev"):
        return False
    with path.open("rb") as file:
        if file.read(len(text) + 1) == text:
            return True
    raise MisuseError(
        f"--out {path}: there is another file of this name; remove it, or choose another"
    )


def truth_path(out: Path) -> Path:
    """The path of the truth of ``out``: run.truth.jsonl.gz for run.jsonl.gz."""
    stem = out.name.removesuffix(".gz").removesuffix(".jsonl")
    return out.with_name(f"{stem}.truth{out.name.removeprefix(stem)}")


def _lines(path: Path, documents: Iterable[dict[str, Any]]) -> bytes:
    text = b"".join(encode(document) + b"\n" for document in documents)
    if path.suffix == ".gz":  # without name and time, so that a run always gives the same file
        text = gzip.compress(text, mtime=0)
    return text
