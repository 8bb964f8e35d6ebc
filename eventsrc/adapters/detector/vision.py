"""Decode, resize, cut and encode pictures and read videos by OpenCV. Only this module imports it.

docs/decisions/dependencies.md says why OpenCV. It is imported when the first picture is decoded.
"""

import functools
import os
import re
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, Final, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from eventsrc.base.errors import MisuseError

from .picture import MAX_PICTURE_PIXELS, PictureError, Pixels, check_picture

Floats = NDArray[np.float32]
Fit: TypeAlias = Literal["crop", "stretch", "pad"]
JPEG_QUALITY: Final = 90
_PADDING: Final = 114
"""The grey around pictures in the training of detectors."""


@functools.cache
def _cv2() -> ModuleType:
    # Read at import. They silence OpenCV and its FFmpeg: faults are in our own messages.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    try:
        import cv2
    except ImportError:
        raise MisuseError(
            "pictures need OpenCV; install mapfold with the extra detector: "
            "pip install 'mapfold[detector]'"
        ) from None
    return cv2


def check_installed() -> None:
    """Raise MisuseError, naming the extra, where OpenCV is missing."""
    _cv2()


def decode(data: bytes) -> Pixels:
    """The pixels of a JPEG or PNG. Raises PictureError, also for one that is damaged inside."""
    check_picture(data)
    cv2 = _cv2()
    with _decoder_messages() as messages:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if messages:
        raise PictureError(f"it is damaged: {messages[0]}")
    if pixels is None:
        raise PictureError("it cannot be decoded")
    decoded: Pixels = pixels
    return decoded


_stderr = threading.Lock()
_PADDED: Final = re.compile(
    r"Corrupt JPEG data: (\d|1[0-6]) extraneous bytes before marker 0xd9", re.ASCII
)
"""Padding before the end mark, which many cameras that compress in hardware add; no damage."""


@contextmanager
def _decoder_messages() -> Iterator[list[str]]:
    """Collect the messages of the decoders' C libraries; the list is filled after the block.

    They report a damaged JPEG on file descriptor 2 only, and decode the rest of it to grey. So
    stderr is a file in memory within the block; other output there is passed on afterwards.
    """
    messages: list[str] = []
    with _stderr:
        scratch, real = _scratch(), os.dup(2)
        os.dup2(scratch, 2)
        try:
            yield messages
        finally:
            os.dup2(real, 2)
            printed = os.lseek(scratch, 0, os.SEEK_CUR)
            if printed:
                for line in os.pread(scratch, printed, 0).splitlines(keepends=True):
                    text = line.decode("utf-8", "replace").strip()
                    if _PADDED.fullmatch(text):
                        continue
                    if text.startswith(("Corrupt JPEG", "Premature end", "libpng", "Invalid ")):
                        messages.append(text)
                    else:
                        os.write(real, line)
                os.ftruncate(scratch, 0)
                os.lseek(scratch, 0, os.SEEK_SET)
            os.close(real)


@functools.cache
def _scratch() -> int:
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())


def colour_order(pixels: NDArray[np.uint8], order: Literal["rgb", "mono"]) -> Pixels:
    """Rows of red, green and blue, or of grey, as `Pixels`."""
    cv2 = _cv2()
    code = cv2.COLOR_RGB2BGR if order == "rgb" else cv2.COLOR_GRAY2BGR
    turned: Pixels = cv2.cvtColor(pixels, code)
    return turned


def encode_jpeg(pixels: Pixels) -> bytes:
    """A JPEG of the pixels."""
    cv2 = _cv2()
    done, data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise PictureError("it cannot be encoded as JPEG")
    return bytes(data)


def shrunk(pixels: Pixels, side: int) -> Pixels:
    """``pixels``, made smaller where they are wider or higher than ``side``."""
    height, width = pixels.shape[:2]
    ratio = side / max(height, width)
    if ratio >= 1.0:
        return pixels
    size = max(1, round(width * ratio)), max(1, round(height * ratio))
    cv2 = _cv2()
    smaller: Pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    return smaller


@dataclass(frozen=True, slots=True)
class Letterbox:
    """The place of a picture in a model's input: scaled along x and y, then shifted."""

    width: int
    height: int
    scale: tuple[float, float]
    offset: tuple[int, int]

    @classmethod
    def of(cls, width: int, height: int, size: tuple[int, int], *, centred: bool) -> "Letterbox":
        """The largest that fits into ``size``, width and height of the input. The aspect ratio is
        kept, except for rounding to whole pixels."""
        ratio = min(size[0] / width, size[1] / height)
        inner = max(1, round(width * ratio)), max(1, round(height * ratio))
        free = size[0] - inner[0], size[1] - inner[1]
        offset = (free[0] // 2, free[1] // 2) if centred else (0, 0)
        return cls(width, height, (inner[0] / width, inner[1] / height), offset)

    @property
    def inner(self) -> tuple[int, int]:
        """Width and height that the picture takes in the input."""
        return round(self.width * self.scale[0]), round(self.height * self.scale[1])

    def to_picture(self, boxes: NDArray[np.float64]) -> NDArray[np.float64]:
        """Boxes (x0, y0, x1, y1) in the input as pixels of the picture, clipped to it."""
        offset, scale = np.array(self.offset * 2), np.array(self.scale * 2)
        limit = np.array((self.width, self.height) * 2, np.float64)
        moved: NDArray[np.float64] = np.clip((boxes - offset) / scale, 0.0, limit)
        return moved


class Canvas:
    """A buffer in the size of a model's input, reused for each picture."""

    def __init__(self, size: tuple[int, int], *, centred: bool) -> None:
        self._size, self._centred = size, centred
        self._pixels = np.full((size[1], size[0], 3), _PADDING, np.uint8)
        self._last: Letterbox | None = None

    def lay(self, pixels: Pixels) -> tuple[Pixels, Letterbox]:
        """``pixels`` scaled to the input's size with grey around. Valid until the next call."""
        cv2 = _cv2()
        height, width = pixels.shape[:2]
        box = Letterbox.of(width, height, self._size, centred=self._centred)
        if box != self._last:
            self._pixels[:] = _PADDING
            self._last = box
        (x, y), (inner_w, inner_h) = box.offset, box.inner
        target = self._pixels[y : y + inner_h, x : x + inner_w]
        if (width, height) == box.inner:
            target[:] = pixels
        else:
            target[:] = cv2.resize(pixels, box.inner, interpolation=_method(width, inner_w))
        return self._pixels, box


class Scaling(NamedTuple):
    """The normalisation of a model's input: value times ``gain`` plus ``shift`` for each channel,
    red first if ``rgb``, else blue first."""

    rgb: bool
    gain: tuple[float, ...]
    shift: tuple[float, ...]

    @classmethod
    def of(
        cls, *, rgb: bool, scale: float, mean: Sequence[float], std: Sequence[float]
    ) -> "Scaling":
        """(value * scale - mean) / std."""
        gain = tuple(scale / spread for spread in std)
        return cls(rgb, gain, tuple(-m / s for m, s in zip(mean, std, strict=True)))


def planes(pictures: Sequence[Pixels], scaling: Scaling, out: Floats | None = None) -> Floats:
    """Pictures of one size as (n, 3, height, width), in ``out`` if it is given."""
    cv2 = _cv2()
    if out is None:
        out = np.empty((len(pictures), 3, *pictures[0].shape[:2]), np.float32)
    for target, pixels in zip(out, pictures, strict=True):
        channels = cv2.split(pixels)  # several times as fast as blobFromImages of OpenCV 5
        for index, channel in enumerate(channels[::-1] if scaling.rgb else channels):
            np.multiply(channel, np.float32(scaling.gain[index]), out=target[index])
            if scaling.shift[index]:
                target[index] += np.float32(scaling.shift[index])
    return out


def fitted(pixels: Pixels, size: tuple[int, int], fit: Fit, *, cubic: bool) -> Pixels:
    """A picture resized to ``size``, width and height: stretched; its middle, cut; or padded with
    black."""
    cv2 = _cv2()
    height, width = pixels.shape[:2]
    if fit == "stretch":
        done: Pixels = cv2.resize(pixels, size, interpolation=_method(width, size[0], cubic))
        return done
    ratios = size[0] / width, size[1] / height
    ratio = max(ratios) if fit == "crop" else min(ratios)
    if fit == "crop":
        # Cut before resizing, so that a wide crop does not become huge.
        keep_w, keep_h = min(width, size[0] / ratio), min(height, size[1] / ratio)
        x, y = round((width - keep_w) / 2), round((height - keep_h) / 2)
        middle = pixels[y : y + max(1, round(keep_h)), x : x + max(1, round(keep_w))]
        cut: Pixels = cv2.resize(
            middle, size, interpolation=_method(middle.shape[1], size[0], cubic)
        )
        return cut
    inner = max(1, round(width * ratio)), max(1, round(height * ratio))
    padded = np.zeros((size[1], size[0], 3), np.uint8)
    x, y = (size[0] - inner[0]) // 2, (size[1] - inner[1]) // 2
    padded[y : y + inner[1], x : x + inner[0]] = cv2.resize(
        pixels, inner, interpolation=_method(width, inner[0], cubic)
    )
    return padded


def _method(before: int, after: int, cubic: bool = False) -> int:
    """Areas are averaged where a picture shrinks, so that nothing is left out."""
    cv2 = _cv2()
    if after < before:
        shrinking: int = cv2.INTER_AREA if cubic or before > 2 * after else cv2.INTER_LINEAR
        return shrinking
    growing: int = cv2.INTER_CUBIC if cubic else cv2.INTER_LINEAR
    return growing


class Video:
    """The frames of a video file, one after the other."""

    def __init__(self, path: Path) -> None:
        cv2 = _cv2()
        self._capture: Any = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
        if not self._capture.isOpened():
            raise PictureError("it cannot be opened as a video")
        rate = float(self._capture.get(cv2.CAP_PROP_FPS))
        self.frames_per_s: float | None = rate if 0.0 < rate < 10_000.0 else None
        size = [self._capture.get(p) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)]
        if size[0] * size[1] > MAX_PICTURE_PIXELS:
            raise PictureError(f"a frame has more than {MAX_PICTURE_PIXELS:,} pixels")

    def next(self) -> bool:
        """Go to the next frame; False at the end."""
        return bool(self._capture.grab())

    def pixels(self) -> Pixels:
        """The frame. Raises PictureError if it cannot be decoded."""
        done, pixels = self._capture.retrieve()
        if not done or pixels is None:
            raise PictureError("this frame cannot be decoded")
        decoded: Pixels = pixels
        return decoded

    def close(self) -> None:
        """Close the file."""
        self._capture.release()
