"""Pictures from files and over Zenoh.

Files are a folder or a video. The time at which a picture was taken:

* Of a folder it is in the file's name, in seconds with a point or in nanoseconds, as in the data
  sets of TUM and EuRoC: ``1777885200.05.jpg``, ``1403636579763555584.png``. For other names a rate
  in pictures a second must be given.
* Of a video's frames it follows from a start and the video's rate.

Over Zenoh a picture is a JPEG or PNG as it is, or in CDR sensor_msgs/CompressedImage or
sensor_msgs/Image, as a bridge of ROS 2 forwards them. Without a stamp of its own it has its time of
receipt. Zenoh's thread only puts messages into queues. The queue of pictures is short and drops the
oldest: a detector that is slower than the camera processes current pictures, and counts those it
missed.
"""

import re
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from eventsrc.base.errors import MisuseError, TransportError
from eventsrc.base.machine import Clock, system_clock
from eventsrc.base.text import visible
from eventsrc.base.user_files import FileFault, open_file
from eventsrc.envelope.cdr import CdrFault, CdrFields, is_cdr
from eventsrc.envelope.model import MAX_TIMESTAMP_S
from eventsrc.record.transport.session import Received, Session, SizeLimit

from . import picture
from .poses import LivePoses, MessageError, header_stamp
from .vision import Video, colour_order, decode

SUFFIXES: Final = frozenset({".jpg", ".jpeg", ".png"})
_TIME: Final = re.compile(r"[0-9]{1,10}\.[0-9]{1,9}|[0-9]{10}|[0-9]{16,19}", re.ASCII)
"""A time in a file's name. ``000017`` is the number of a picture, not a time."""
_NANOSECOND_DIGITS: Final = 16
_PARTS: Final = re.compile(r"([0-9]+)", re.ASCII)


class Timing(NamedTuple):
    """The times of pictures without one of their own: ``per_s`` a second from ``start_s`` on."""

    start_s: float = 0.0
    per_s: float | None = None

    def stamp_s(self, index: int, per_s: float | None = None) -> float | None:
        """The time of picture ``index``; None without a rate."""
        rate = self.per_s or per_s
        return None if rate is None else self.start_s + index / rate


def open_images(text: str, timing: Timing) -> Iterator[picture.Picture]:
    """The pictures of ``--images``. Raises MisuseError before the first, and where a picture has no
    time."""
    path = Path(text)
    if path.is_dir():
        found = sorted((p for p in path.iterdir() if p.suffix.lower() in SUFFIXES), key=_in_order)
        if not found:
            raise MisuseError(f"--images {text}: no .jpg, .jpeg or .png in this folder")
        if timing.per_s is None:
            found.sort(key=_stamp_in)  # 5.25 before 5.5
        return _from_paths(found, timing)
    if not path.is_file():
        raise MisuseError(f"--images {text}: no such folder or video")
    if path.suffix.lower() in SUFFIXES:
        return _from_paths([path], timing)
    try:
        video = Video(path)
    except picture.PictureError as error:
        raise MisuseError(
            f"--images {text}: {error}; give a folder of pictures or a video"
        ) from None
    return _from_video(path, video, timing)


def _in_order(path: Path) -> list[tuple[int, int, str]]:
    """A sort key that orders numbers in names by value: 2.png before 10.png."""
    return [
        (0, int(part), "") if part.isascii() and part.isdigit() else (1, 0, part)
        for part in _PARTS.split(path.name)
    ]


def _from_paths(paths: Iterable[Path], timing: Timing) -> Iterator[picture.Picture]:
    for index, path in enumerate(paths):
        stamp_s = timing.stamp_s(index)
        if stamp_s is None:
            stamp_s = _stamp_in(path)
        yield picture.Picture(visible(str(path)), stamp_s, _reader(path))


def _stamp_in(path: Path) -> float:
    text = path.stem
    if _TIME.fullmatch(text):
        nanoseconds = len(text) >= _NANOSECOND_DIGITS and "." not in text
        stamp_s = int(text) / 1e9 if nanoseconds else float(text)
        if stamp_s <= MAX_TIMESTAMP_S:
            return stamp_s
    raise MisuseError(
        f"{visible(str(path))}: its name is no time; name pictures by the time they were taken, in"
        " seconds with a point or nanoseconds, or give --fps N for N pictures a second from --start"
        " on"
    )


def _reader(path: Path) -> Callable[[], picture.Pixels]:
    def pixels() -> picture.Pixels:
        try:
            with open_file(path) as file:
                data = file.read(picture.MAX_PICTURE_BYTES + 1)
        except FileFault as fault:
            raise picture.PictureError(str(fault)) from None
        except OSError as error:
            raise picture.PictureError(error.strerror or str(error)) from None
        return decode(data)

    return pixels


def _from_video(path: Path, video: Video, timing: Timing) -> Iterator[picture.Picture]:
    try:
        if timing.per_s is None and video.frames_per_s is None:
            raise MisuseError(f"--images {path}: this video does not state its rate; give --fps")
        index = 0
        while video.next():
            stamp_s = timing.stamp_s(index, video.frames_per_s)
            yield picture.Picture(
                f"{visible(str(path))}, frame {index}", stamp_s or 0.0, video.pixels
            )
            index += 1
        if index == 0:
            raise MisuseError(f"--images {path}: no frame in this video can be read")
    finally:
        video.close()


QUEUE: Final = 4
_MAX_POSE_BYTES: Final = 64 * 1024
_POLL_S: Final = 0.25


class NewestQueue:
    """A queue of at most ``size`` pictures; one more replaces the oldest. Thread-safe."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._waiting: deque[tuple[Received, float]] = deque()
        self._filled = threading.Condition()
        self.dropped = 0
        """Number of pictures dropped for newer ones, or when the queue was closed."""
        self.too_large = 0
        """Number of pictures refused because they are too large."""

    def put(self, message: Received, received_s: float) -> None:
        """Add a picture."""
        with self._filled:
            if len(self._waiting) == self._size:
                self._waiting.popleft()
                self.dropped += 1
            self._waiting.append((message, received_s))
            self._filled.notify()

    def refuse(self) -> None:
        """Count a picture that is too large."""
        self.too_large += 1

    def close(self) -> None:
        """Drop the pictures in the queue."""
        with self._filled:
            self.dropped += len(self._waiting)
            self._waiting.clear()

    def get(self, timeout_s: float) -> tuple[Received, float] | None:
        """Remove and return the oldest picture with its time of receipt; None after ``timeout_s``
        without one."""
        with self._filled:
            if not self._waiting:
                self._filled.wait(timeout_s)
            return self._waiting.popleft() if self._waiting else None


class LivePictures:
    """Pictures under ``image_key`` and poses under ``pose_key``; iterating ends with ``stop``."""

    def __init__(
        self,
        session: Session,
        image_key: str | None,
        pose_key: str | None,
        stop: threading.Event,
        *,
        queue: int = QUEUE,
        clock: Clock = system_clock,
    ) -> None:
        self._session, self._stop, self._clock = session, stop, clock
        self.queue = NewestQueue(queue)
        self.poses: LivePoses | None = None
        if pose_key is not None:
            poses = self.poses = LivePoses()
            too_large = f"a message of more than {_MAX_POSE_BYTES:,} bytes"
            session.subscribe(
                pose_key,
                lambda message: poses.put(message.payload, self._now_s()),
                SizeLimit(_MAX_POSE_BYTES, lambda: poses.refuse(too_large)),
                in_order=True,
            )
        if image_key is not None:
            session.subscribe(
                image_key,
                lambda message: self.queue.put(message, self._now_s()),
                SizeLimit(picture.MAX_PICTURE_BYTES, self.queue.refuse),
                in_order=True,  # behind its pose
            )
        session.confirm()

    def __iter__(self) -> Iterator[picture.Picture]:
        number = 0
        while not self._stop.is_set():
            found = self.queue.get(_POLL_S)
            if found is None:
                continue
            message, received_s = found
            name = f"{message.key}, picture {number}"
            number += 1
            try:
                yield picture_of(message.payload, name, received_s)
            except MessageError as error:
                yield picture.Picture(name, received_s, partial(_refuse, str(error)))
        with suppress(TransportError):
            self._session.confirm()  # what the router has by now is here, and counted
        self.queue.close()

    def _now_s(self) -> float:
        return self._clock() / 1e9


def _refuse(reason: str) -> picture.Pixels:
    raise picture.PictureError(reason)


_CHANNELS: Final[Mapping[str, int]] = {"bgr8": 3, "rgb8": 3, "8UC3": 3, "mono8": 1, "8UC1": 1}


def picture_of(payload: bytes, name: str, received_s: float) -> picture.Picture:
    """The picture of a message, not decoded. Raises MessageError if its header cannot be read."""
    if not is_cdr(payload):
        return picture.Picture(name, received_s, lambda: decode(payload))
    try:
        return _compressed(payload, name, received_s)
    except CdrFault as first:
        try:
            return _raw(payload, name, received_s)
        except CdrFault as second:
            raise MessageError(
                f"neither sensor_msgs/CompressedImage ({first}) nor sensor_msgs/Image ({second})"
            ) from None


def _compressed(payload: bytes, name: str, received_s: float) -> picture.Picture:
    fields = CdrFields(payload)
    stamp_s = header_stamp(fields, received_s)
    fields.text("format")
    (length,) = fields.numbers("I", "the length of data")
    data = bytes(fields.last(length, "data"))
    return picture.Picture(name, stamp_s, lambda: decode(data))


def _raw(payload: bytes, name: str, received_s: float) -> picture.Picture:
    fields = CdrFields(payload)
    stamp_s = header_stamp(fields, received_s)
    height, width = fields.numbers("II", "height and width")
    encoding = fields.text("encoding").decode("utf-8", "replace")
    fields.numbers("B", "is_bigendian")
    step, length = fields.numbers("II", "step and the length of data")
    data = fields.last(length, "data")
    if encoding not in _CHANNELS:
        raise MessageError(
            f"sensor_msgs/Image of encoding {encoding[:40]!r}; {', '.join(_CHANNELS)} can be read"
        )
    channels = _CHANNELS[encoding]
    if not 0 < width * height <= picture.MAX_PICTURE_PIXELS or step < width * channels:
        raise MessageError(f"sensor_msgs/Image of {width:,} × {height:,} pixels, step {step:,}")
    if length != step * height:
        raise MessageError(f"sensor_msgs/Image of {length:,} bytes instead of {step * height:,}")

    def pixels() -> picture.Pixels:
        rows = np.frombuffer(data, np.uint8).reshape(height, step)[:, : width * channels]
        shaped = np.ascontiguousarray(rows).reshape(height, width, channels)
        if channels == 1:
            return colour_order(shaped, "mono")
        return colour_order(shaped, "rgb") if encoding == "rgb8" else shaped

    return picture.Picture(name, stamp_s, pixels)
