"""Bags written by rosbags, and the same detections as JSON lines.

A drive as bags, bags imported, and the envelopes in a log.
"""

import json
import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from eventsrc.log import LogWriter
from eventsrc.record.importers.bag_streams import BagOptions
from eventsrc.record.importers.known_log import ImportReport
from eventsrc.record.importers.run import import_files
from eventsrc.ros.transforms import Transform
from tests.support import ros_messages as ros
from tests.support.fixtures_log import read_log
from tests.support.ros_messages import OPTICAL, SECOND, START, TYPES, flat

Recorded = tuple[str, int, Any]
"""Topic, time of receipt and message."""
STORAGES = {"mcap": StoragePlugin.MCAP, "sqlite": StoragePlugin.SQLITE3}
COMPRESSIONS = {
    "none": CompressionMode.NONE,
    "file": CompressionMode.FILE,
    "message": CompressionMode.MESSAGE,
}


def write_bag(
    path: Path, recorded: Iterable[Recorded], storage: str = "mcap", compression: str = "none"
) -> Path:
    """A bag as rosbag2 writes it."""
    writer = Writer(path, version=9, storage_plugin=STORAGES[storage])
    if compression != "none":
        writer.set_compression(COMPRESSIONS[compression], CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for topic, received_ns, message in recorded:
            type_name = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, type_name, typestore=TYPES._store)
            payload = message if isinstance(message, Raw) else TYPES.encode(message, type_name)
            writer.write(connections[topic], received_ns, bytes(payload))
    return path


class Raw(bytes):
    """Bytes on a topic of a type, whatever they are."""

    __msgtype__: str

    def __new__(cls, type_name: str, payload: bytes) -> "Raw":
        made = super().__new__(cls, payload)
        made.__msgtype__ = type_name
        return made


MOUNT = flat(0.2, 0.0, 0.0, 0.3)
SLIP = flat(3.0, -1.0, 0.4)
"""The odometry's frame in the map."""
CLASSES = ("cup", "chair", "plant")
CAMERA = {"hfov_deg": 90.0, "width_px": 640.0, "height_px": 480.0, "yaw_rad": 0.0}
RUN = "drive-20240501T100000"
"""The run of a bag called drive that begins at START."""


class Drive:
    """A robot that drives in a circle and takes pictures halfway between its odometry's transforms.
    What it sees is told as messages of ROS and as envelopes, each made by its own way."""

    def __init__(self, pictures: int, *, dim: int = 8, seed: int = 1, prefix: str = "") -> None:
        self.pictures = pictures
        self._dim = dim
        self._seed = seed
        self._prefix = prefix

    def place(self, number: int) -> tuple[float, float, float]:
        """The base in the odometry's frame at transform ``number``."""
        turn = number * 0.02
        return 4.0 * math.cos(turn), 4.0 * math.sin(turn), turn + math.pi / 2

    def stamp(self, number: int) -> int:
        return START + number * SECOND // 10

    def shown_at(self, number: int) -> int:
        return self.stamp(number) + SECOND // 20

    def _seen(self, number: int) -> list[tuple[str, float, tuple[float, ...], np.ndarray]]:
        rng = np.random.default_rng((self._seed, number))
        return [
            (
                CLASSES[int(rng.integers(3))],
                0.5 + 0.5 * round(float(rng.random()), 3),
                (float(rng.integers(100, 500)), float(rng.integers(100, 300)), 40.0, 60.0),
                rng.normal(size=self._dim).astype(np.float32),
            )
            for _ in range(int(rng.integers(0, 3)))
        ]

    def messages(self) -> Iterator[Recorded]:
        """In order of receipt: transforms around each picture, then the picture, then its
        embeddings."""
        at = self._prefix
        yield (
            f"{at}/tf_static",
            START,
            ros.tf(
                ros.transform("base_link", "camera", 0, MOUNT),
                ros.transform("camera", "camera_optical", 0, OPTICAL),
            ),
        )
        yield f"{at}/camera_info", START, ros.camera_info(START, "camera_optical", 320.0)
        for number in range(self.pictures + 2):
            stamp = self.stamp(number)
            yield (
                f"{at}/tf",
                stamp,
                ros.tf(
                    ros.transform("odom", "base_link", stamp, flat(*self.place(number))),
                    ros.transform("map", "odom", stamp - SECOND // 50, SLIP),
                ),
            )
            if number >= self.pictures:
                continue
            taken = self.shown_at(number)
            seen = self._seen(number)
            each = [ros.detection([(c, s), ("other", 0.1)], ros.box(*b)) for c, s, b, _ in seen]
            shown = ros.detections(taken, "camera_optical", *each)
            yield f"{at}/detections", taken, shown
            vectors = [vector for *_, vector in seen]
            yield f"{at}/embeddings", taken, ros.embeddings(taken, vectors, "toy")

    def envelopes(self, run_id: str) -> Iterator[bytes]:
        """By plane trigonometry."""
        slip_x, slip_y = SLIP.x, SLIP.y
        slip = 2.0 * math.atan2(SLIP.qz, SLIP.qw)
        for number in range(self.pictures):
            before, after = self.place(number), self.place(number + 1)
            x, y, yaw = ((a + b) / 2.0 for a, b in zip(before, after, strict=True))
            heading = slip + yaw
            map_x = slip_x + x * math.cos(slip) - y * math.sin(slip) + 0.2 * math.cos(heading)
            map_y = slip_y + x * math.sin(slip) + y * math.cos(slip) + 0.2 * math.sin(heading)
            document = {
                "run_id": run_id,
                "keyframe_id": number,
                "timestamp": self.shown_at(number) / SECOND,
                "map_x": round(map_x, 6),
                "map_y": round(map_y, 6),
                "map_yaw": round(math.remainder(heading, math.tau), 9),
                "camera": CAMERA,
                "detections": [
                    {
                        "class": name,
                        "confidence": score,
                        "bbox": [b[0] - 20.0, b[1] - 30.0, b[0] + 20.0, b[1] + 30.0],
                        "embedding": ros.base64_of(vector),
                        "embedding_dim": self._dim,
                        "embedding_model": "toy",
                    }
                    for name, score, b, vector in self._seen(number)
                ],
            }
            yield json.dumps(document).encode()


__all__ = ["Drive", "Raw", "Recorded", "Transform", "write_bag"]


DRIVE = Drive(40)


def imported(log: Path, *names: Path, **options: Any) -> ImportReport:
    """Import into a log."""
    with LogWriter(log) as writer:
        return import_files(writer, [*map(str, names)], bags=BagOptions(**options))


def envelopes(log: Path) -> list[Any]:
    """The JSON of a log's envelopes."""
    return [json.loads(e.payload) for e in read_log(log) if not e.key.startswith("mapfold/")]
