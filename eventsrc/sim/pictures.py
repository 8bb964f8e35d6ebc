"""The camera's pictures along a drive, with poses and truth: into a folder, or over Zenoh.

A folder gets a JPEG for each picture, named by the time it was taken, ``poses.csv`` with a pose of
the localisation for each, and ``truth.jsonl`` with what each shows; `mapfold detect` reads the
first two. Over Zenoh a picture is sensor_msgs/CompressedImage in CDR, as a bridge of ROS 2 sends
it, and its pose, just before it, JSON.
"""

import itertools
import math
import struct
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from eventsrc.advised import advised
from eventsrc.detector.vision import encode_jpeg
from eventsrc.envelope import RunId
from eventsrc.errors import MisuseError, TransportError
from eventsrc.progress import reported
from eventsrc.transport.session import Session

from .camera import Camera
from .house import build_house
from .random_streams import stream
from .run import DEFAULT_SEED, encode, noisy_pose, start_of
from .tour import EXPLORER, TruePose, drive, keyframes, plan_tour

PER_S: Final = 5.0
_SLACK_S: Final = 1e-6


@dataclass(frozen=True, slots=True)
class CameraPicture:
    """A picture: when it was taken, where the localisation was then, and what it truly shows."""

    stamp_s: float
    time_s: float
    """Since the drive began."""
    pose: dict[str, float]
    jpeg: bytes
    truth: dict[str, Any]


def camera_pictures(
    seed: int = DEFAULT_SEED,
    run: str = EXPLORER,
    *,
    per_s: float = PER_S,
    until_s: float = math.inf,
) -> Iterator[CameraPicture]:
    """The pictures of ``run`` through house ``seed``, ``per_s`` a second; 0 is one for each of the
    run's keyframes. ``until_s`` ends the drive sooner."""
    house = build_house(seed)
    camera = Camera(house)
    run_id, start_s = RunId(f"sim-{seed}-{run}"), start_of(run)
    driven = itertools.takewhile(
        lambda pose: pose.time_s <= until_s, drive(house.grid, plan_tour(house, run))
    )
    poses = list(_at_rate(driven, per_s) if per_s > 0 else keyframes(driven))
    for number, pose in enumerate(reported(poses, "drawing", len(poses), "pictures")):
        rng = stream("picture", run_id, number)
        view = camera.draw(pose)
        stamp_s = round(start_s + pose.time_s, 3)
        truth = {
            "stamp": stamp_s,
            "room": house.plan.room_at(pose.x, pose.y),
            "things": [
                {"instance": shown.instance, "class": shown.class_name, "box": shown.box}
                for shown in view.shown
            ],
        }
        noisy = {name.removeprefix("map_"): at for name, at in noisy_pose(pose, rng).items()}
        yield CameraPicture(stamp_s, pose.time_s, noisy, encode_jpeg(view.pixels), truth)


def _at_rate(poses: Iterator[TruePose], per_s: float) -> Iterator[TruePose]:
    taken = 0
    for pose in poses:
        if pose.time_s >= taken / per_s - _SLACK_S:
            taken = math.floor(pose.time_s * per_s + _SLACK_S) + 1
            yield pose


def write_pictures(pictures: Iterator[CameraPicture], folder: Path, stop: threading.Event) -> int:
    """Write pictures, poses and truth until ``stop`` is set; returns how many pictures.

    Raises MisuseError if the folder is not empty or cannot be written.
    """
    written = 0
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise MisuseError(f"--camera {folder}: this folder is not empty; choose another")
        with (
            (folder / "poses.csv").open("w", encoding="utf-8") as poses,
            (folder / "truth.jsonl").open("wb") as truth,
        ):
            poses.write("stamp,x,y,yaw\n")
            for picture in pictures:
                if stop.is_set():
                    break
                (folder / f"{picture.stamp_s:.3f}.jpg").write_bytes(picture.jpeg)
                at = picture.pose
                poses.write(f"{picture.stamp_s:.3f},{at['x']},{at['y']},{at['yaw']}\n")
                truth.write(encode(picture.truth) + b"\n")
                written += 1
    except OSError as error:
        raise MisuseError(
            f"--camera {folder}: cannot be written: {error.strerror}; choose another"
        ) from None
    return written


def publish_pictures(
    session: Session,
    pictures: Iterator[CameraPicture],
    image_key: str,
    pose_key: str,
    *,
    speed: float,
    wait_s: float,
    stop: threading.Event,
) -> int:
    """Publish pictures and poses, ``speed`` times as fast as the robot drove, until ``stop`` is
    set; 0 is unpaced. Returns how many pictures. TransportError without a subscriber in time."""
    images, poses = session.publisher(image_key), session.publisher(pose_key)
    if not images.wait_for_subscriber(wait_s):
        raise TransportError(
            f"no one subscribed to {image_key!r} within {wait_s:g} s; start"
            f" `{advised('detect', '--zenoh-image', image_key)}` first or wait longer with --wait"
        )
    sent = 0
    started = time.monotonic()
    for picture in pictures:
        due = started + picture.time_s / speed if speed > 0 else started
        if stop.wait(max(0.0, due - time.monotonic())):
            break
        poses.put(encode({"stamp": picture.stamp_s, **picture.pose}))
        images.put(compressed_image(picture.stamp_s, picture.jpeg))
        sent += 1
    session.confirm()
    return sent


def compressed_image(stamp_s: float, jpeg: bytes) -> bytes:
    """sensor_msgs/CompressedImage in CDR, little endian."""
    seconds = math.floor(stamp_s)
    body = struct.pack("<iI", seconds, round((stamp_s - seconds) * 1e9))
    for text in (b"camera\0", b"jpeg\0"):
        body += struct.pack("<I", len(text)) + text
        body += bytes(-len(body) % 4)
    return b"\0\1\0\0" + body + struct.pack("<I", len(jpeg)) + jpeg
