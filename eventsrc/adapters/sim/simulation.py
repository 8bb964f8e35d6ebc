"""Simulate a run through a house, and publish it over Zenoh or write it to a file.

Run ``a`` explores; it looks around at every viewpoint of every room and of the hall, and at the end
in the wide opening between living and dining room. Any other run looks around at its first stop,
anywhere in the house, and visits all rooms in its own order, looking around in about half of them.

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
from typing import Any, TypeVar

import numpy as np

from eventsrc.base.errors import MisuseError, TransportError
from eventsrc.base.progress import reported
from eventsrc.base.text import advised
from eventsrc.base.user_files import write_files
from eventsrc.envelope.commands import UseSettings
from eventsrc.envelope.model import KeyframeId, RunId, default_det_id, stamp_ns
from eventsrc.record.importers.json_lines import command_record
from eventsrc.record.transport.session import Publisher, Session

from .detector import HEIGHT_PX, HFOV_DEG, WIDTH_PX, detect, visible_objects
from .drive import Stop, TruePose, drive, keyframes, nearest_by_route
from .floorplan import HALL, OPENING_M, PlannedRoom, Point, wrap
from .house import House, build_house
from .random_streams import bernoulli, normal, stream, uniform

DEFAULT_SEED = 7
EXPLORER = "a"
FIRST_START_S = 1_777_885_200.0
"""The start of run a, 2026-05-04 09:00 UTC. Each further run starts a day later."""
_DAY_S = 86_400.0
_POSITION_NOISE_M = 0.012
_YAW_NOISE_RAD = 0.008
_TWO_VIEWS_FROM_M = 5.0
_SEARCH_M = 1.2
_MOVE_M = 0.6


Item = TypeVar("Item")


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


def plan_tour(house: House, run: str) -> tuple[Stop, ...]:
    """The stops of ``run``; it starts at the first."""
    return _explore(house) if run == EXPLORER else _revisit(house, run)


def _explore(house: House) -> tuple[Stop, ...]:
    views = [spot for room in house.plan.rooms for spot in _viewpoints(house, room)]
    hall = _viewpoints(house, house.plan.room(HALL))
    here = hall[0]
    stops = [Stop(here, look_around=True)]
    left = [view for view in views if view != here]
    while left:  # next the nearest unseen viewpoint, by the length of the route
        here = nearest_by_route(house.grid, here, left)
        left.remove(here)
        stops.append(Stop(here, look_around=True))
    return (*stops, Stop(_opening(house), look_around=True))


def _revisit(house: House, run: str) -> tuple[Stop, ...]:
    rng = stream("tour", house.seed, run)
    rooms = [house.plan.rooms[index] for index in rng.permutation(len(house.plan.rooms)).tolist()]
    stops = [
        Stop(_moved_spot(house, room, spot, rng), bernoulli(rng, 0.5))
        for room in rooms
        for spot in _viewpoints(house, room)
    ]
    return (Stop(stops[0].spot, look_around=True), *stops[1:])


def _viewpoints(house: House, room: PlannedRoom) -> list[Point]:
    """One spot with clearance near the middle; two in a long room."""
    rect = room.rect
    x, y = rect.centre
    wanted = [(x, y)]
    if max(rect.width, rect.height) >= _TWO_VIEWS_FROM_M:
        quarter = rect.width / 4
        wanted = [(rect.x0 + quarter, y), (rect.x1 - quarter, y)]
    return [house.grid.clearest(spot, rect, _SEARCH_M) for spot in wanted]


def _moved_spot(house: House, room: PlannedRoom, spot: Point, rng: np.random.Generator) -> Point:
    """A random free spot up to ``_MOVE_M`` from ``spot`` in x and y; ``spot`` if none is found."""
    for _ in range(50):
        x = round(spot[0] + uniform(rng, -_MOVE_M, _MOVE_M), 2)
        y = round(spot[1] + uniform(rng, -_MOVE_M, _MOVE_M), 2)
        if room.rect.contains(x, y) and house.grid.free(x, y):
            return x, y
    return spot


def _opening(house: House) -> Point:
    door = next(door for door in house.plan.doors if door.width_m == OPENING_M)
    return house.grid.clearest(door.centre, house.plan.outline, 0.5)


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
        "camera": {"hfov_deg": HFOV_DEG, "width_px": WIDTH_PX, "height_px": HEIGHT_PX},
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
    publisher = subscribed(session, key, wait_s, advised("record"))
    watched = reported(run.payloads, "publishing", len(run.envelopes), "keyframes")
    timed = zip(watched, run.true_poses, strict=True)
    sent = 0
    for payload in paced(((each, pose.time_s) for each, pose in timed), speed, stop):
        publisher.put(payload)
        sent += 1
    session.confirm()
    publisher.close()
    return sent


def subscribed(session: Session, key: str, wait_s: float, command: str) -> Publisher:
    """A publisher under ``key`` that has a subscriber; ``command`` is advised to start one. Raises
    TransportError if it has none within ``wait_s`` seconds."""
    publisher = session.publisher(key)
    if not publisher.wait_for_subscriber(wait_s):
        raise TransportError(
            f"no one subscribed to {key!r} within {wait_s:g} s; start `{command}` first "
            "or wait longer with --wait"
        )
    return publisher


def paced(
    timed: Iterable[tuple[Item, float]], speed: float, stop: threading.Event
) -> Iterator[Item]:
    """Yield each item when its time, in seconds since the begin, has come: ``speed`` times as fast,
    at once if that is 0; ends when ``stop`` is set."""
    started = time.monotonic()
    for item, time_s in timed:
        due = started + time_s / speed if speed > 0 else started
        if stop.wait(max(0.0, due - time.monotonic())):
            return
        yield item


def write_run(run: SimulatedRun, out: Path, settings: UseSettings | None = None) -> Path:
    """Write ``run`` as JSON lines to ``out`` (gzip if it ends in .gz); returns the truth's path.
    A log that ``out`` is imported into begins with ``settings``.

    A file that is there stays as it is, since it may be a recorded run: it must hold the same bytes
    already. Raises MisuseError where it holds others or no file can be made, MapfoldError where
    writing it fails.
    """
    truth = truth_path(out)
    lines = list(run.envelopes)
    if settings is not None:
        lines.insert(0, command_record(settings, stamp_ns(run.envelopes[0]["timestamp"])))
    contents = {out: _lines(out, lines), truth: _lines(truth, run.truth)}
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
