"""The pictures of a topic of sensor_msgs/CompressedImage or Image, and crops of detections in them.

A picture comes before the detections that were made of it, so the newest ones are kept until they
do. Detections are of the picture whose stamp is nearest to theirs, at most `_MOST_APART_NS` away.
"""

from collections import deque
from collections.abc import Callable, Sequence
from typing import Final

from eventsrc.envelope.cdr import CdrFault, CdrFields, is_cdr
from eventsrc.envelope.crops import Crop
from eventsrc.envelope.model import KeyframeId, RunId, default_det_id

from .messages import BadMessage, Detected
from .stream import Counts, Stream

IMAGE: Final = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE: Final = "sensor_msgs/msg/CompressedImage"
IMAGES: Final = (IMAGE, COMPRESSED_IMAGE)
_MOST_APART_NS: Final = 10_000_000
"""A third of the time between two pictures of a camera at 30 Hz."""
_MOST_PICTURES: Final = 256
_MOST_BYTES: Final = 256 * 1024 * 1024
_NS: Final = 1_000_000_000

Boxes = Sequence[Sequence[float]]
"""Boxes in a picture: x0, y0, x1 and y1 of each, in pixels."""
CutCrops = Callable[[bytes, Boxes], "Jpegs"]
"""Cuts boxes out of the picture of a message in CDR. Raises BadMessage if it cannot be read."""


Jpegs = Sequence[bytes | None]
"""The crop of each detection; None for one whose box has no pixel of the picture."""


class StreamPictures:
    """The newest pictures of a stream, undecoded, and the crops cut from them. Within bounds of
    their number and bytes the oldest make way, and the newest is always kept."""

    def __init__(self, stream: Stream, cut: CutCrops, counts: Counts) -> None:
        self._run_id, self._topic = RunId(stream.run_id), stream.images or ""
        self._cut, self._counts = cut, counts
        self._kept: deque[tuple[int, bytes]] = deque()
        self._bytes = 0

    def add(self, _topic: str, _type_name: str, payload: bytes) -> None:
        """Keep a message in CDR. Raises BadMessage if it has no stamp."""
        if not is_cdr(payload):
            raise BadMessage(f"it begins with {payload[:4].hex(' ')}, which is no CDR")
        try:
            seconds, nanoseconds = CdrFields(payload).numbers("iI", "header.stamp")
        except CdrFault as fault:
            raise BadMessage(str(fault)) from None
        self._kept.append((seconds * _NS + nanoseconds, payload))
        self._bytes += len(payload)
        while len(self._kept) > 1 and (
            len(self._kept) > _MOST_PICTURES or self._bytes > _MOST_BYTES
        ):
            self._bytes -= len(self._kept.popleft()[1])

    def cut(self, detected: Detected) -> Jpegs | None:
        """The crops of detections, none for a picture that cannot be read, which is counted; None
        without their picture."""
        stamp_ns = detected.stamp_ns
        nearest = min(self._kept, key=lambda kept: abs(kept[0] - stamp_ns), default=None)
        if nearest is None or abs(nearest[0] - stamp_ns) > _MOST_APART_NS:
            return None
        if not detected.detections:
            return ()
        try:
            return self._cut(nearest[1], [each["bbox"] for each in detected.detections])
        except BadMessage as error:
            self._counts.refuse(self._topic, str(error))
            return ()

    def crops(self, keyframe_id: int, detected: Detected, jpegs: Jpegs | None) -> list[Crop]:
        """The crops of a keyframe, counted. Without ``jpegs`` its picture is looked for again: it
        may have come behind its detections."""
        counts = self._counts
        if jpegs is None:
            jpegs = self.cut(detected)
            counts.without_picture += jpegs is None and bool(detected.detections)
        crops = [
            Crop(default_det_id(self._run_id, KeyframeId(keyframe_id), index), jpeg)
            for index, jpeg in enumerate(jpegs or ())
            if jpeg is not None
        ]
        counts.crops += len(crops)
        counts.outside += len(jpegs or ()) - len(crops)
        return crops
