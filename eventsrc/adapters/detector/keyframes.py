"""Make envelopes from pictures by the keyframe gate, the detector and the encoder.

The gate decides which pictures become keyframes: when the robot has moved or turned far enough
since the last keyframe with a pose, or when the time since the last keyframe is up. A picture
without a pose has only the time. The first picture is one, and so is the first with a pose.
"""

import base64
import math
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from eventsrc.envelope.dropped_classes import DROPPED_FIELD
from eventsrc.envelope.model import MAX_TIMESTAMP_S, DetId, KeyframeId, RunId, default_det_id
from eventsrc.ros.messages import BadMessage
from eventsrc.ros.pictures import Boxes

from .picture import Picture, PictureError, Pixels
from .picture_sources import picture_of
from .poses import MessageError, Poses, RobotPose
from .vision import encode_jpeg, shrunk
from .vision_models import Encoder, Finder, Found

MOVED_M = 0.5
TURNED_DEG = 15.0
AFTER_S = 5.0
_SLACK = 1e-6
"""Tolerance for rounding, metres and radians: ten steps of 5 cm count as half a metre."""


@dataclass(frozen=True, slots=True)
class GateLimits:
    """The distance, turn and time after which a keyframe is due; None for ``after_s`` for no time
    limit."""

    moved_m: float = MOVED_M
    turned_rad: float = math.radians(TURNED_DEG)
    after_s: float | None = AFTER_S


class KeyframeGate:
    """Decides for each picture in turn whether it is a keyframe, from the last keyframe."""

    def __init__(self, limits: GateLimits) -> None:
        self._limits = limits
        self._stamp_s: float | None = None
        self._pose: RobotPose | None = None

    def set_last(self, stamp_s: float, pose: RobotPose | None) -> None:
        """Set the last keyframe."""
        self._stamp_s = stamp_s
        self._pose = pose or self._pose

    def is_due(self, stamp_s: float, pose: RobotPose | None) -> bool:
        """Whether this picture should be a keyframe."""
        if self._stamp_s is None or (pose is not None and self._pose is None):
            return True
        after_s = self._limits.after_s
        if after_s is not None and abs(stamp_s - self._stamp_s) >= after_s:
            return True  # also for a stamp that jumps back, as of a recording that starts again
        if pose is None or self._pose is None:
            return False
        moved = math.hypot(pose.x - self._pose.x, pose.y - self._pose.y)
        turned = abs(math.remainder(pose.yaw - self._pose.yaw, math.tau))
        return moved >= self._limits.moved_m - _SLACK or turned >= self._limits.turned_rad - _SLACK


FIRST_KEYFRAME: Final = 1
CROP_SIDE: Final = 640
"""Largest width and height of kept crops: more than encoders take, and always under the 1 MiB that
a log keeps."""
_MOST_NOTES: Final = 5
"""Messages for each kind of fault; further ones are only counted."""


@dataclass
class PictureCounts:
    """Counts of pictures by outcome. Each is one of ``between`` (too near the last keyframe),
    ``unreadable`` or ``keyframes``."""

    pictures: int = 0
    between: int = 0
    unreadable: int = 0
    keyframes: int = 0
    without_pose: int = 0
    detections: int = 0
    """Detections in the keyframes."""
    not_encoded: int = 0
    """Detections without an embedding, because the encoder's answer was not finite or zero."""
    not_finite: int = 0
    """Boxes left out because the detector's answer was not finite."""
    too_small: int = 0
    """Boxes left out because they are less than a pixel wide or high in the picture."""
    cut: int = 0
    """Boxes beyond the most that a picture may have."""
    dropped_detections: int = 0
    """Detections left out by their class."""

    @property
    def lost(self) -> int:
        """The number of faults: pictures, detections and boxes that could not be used."""
        return self.unreadable + self.not_encoded + self.not_finite + self.cut


class CropJpeg(NamedTuple):
    """The JPEG of a detection's box."""

    det_id: DetId
    jpeg: bytes


class DetectedKeyframe(NamedTuple):
    """The JSON document of an envelope, and the crops of its detections if they are kept."""

    envelope: dict[str, Any]
    crops: list[CropJpeg]


class Keyframes:
    """Detects objects in one picture after the other; ``note`` receives lines about faults."""

    def __init__(
        self,
        finder: Finder,
        encoder: Encoder,
        gate: KeyframeGate,
        poses: Poses,
        run_id: RunId,
        *,
        hfov_deg: float | None = None,
        keep_crops: bool = False,
        drop_classes: Collection[str] = (),
        note: Callable[[str], None],
    ) -> None:
        self._drop_classes = frozenset(drop_classes)
        self._finder, self._encoder, self._gate, self._poses = finder, encoder, gate, poses
        self._run_id, self._hfov_deg, self._keep_crops = run_id, hfov_deg, keep_crops
        self._note = note
        self._noted: dict[str, int] = {}
        self.counts = PictureCounts()

    def process(self, picture: Picture) -> DetectedKeyframe | None:
        """The keyframe of a picture; None if it is left out. Raises ModelError."""
        counts = self.counts
        counts.pictures += 1
        if not 0.0 <= picture.stamp_s <= MAX_TIMESTAMP_S:
            self._skip(picture, f"its time, {picture.stamp_s:g} s, is out of range")
            return None
        pose = self._poses.at(picture.stamp_s)
        if not self._gate.is_due(picture.stamp_s, pose):
            counts.between += 1
            return None
        try:
            pixels = picture.pixels()
        except PictureError as error:
            self._skip(picture, str(error))
            return None
        self._gate.set_last(picture.stamp_s, pose)
        whole = self._finder.find(pixels)
        found = whole.without(self._drop_classes)
        self._count(picture, found)
        dropped = len(whole.labels) - len(found.labels)
        counts.dropped_detections += dropped
        counts.keyframes += 1
        counts.without_pose += pose is None
        keyframe = self._keyframe(picture, pixels, pose, found)
        if dropped:
            keyframe.envelope[DROPPED_FIELD] = dropped
        return keyframe

    def _skip(self, picture: Picture, reason: str) -> None:
        self.counts.unreadable += 1
        self._note_fault("unreadable", f"{picture.name}: left out: {reason}")

    def _count(self, picture: Picture, found: Found) -> None:
        counts = self.counts
        counts.detections += len(found.labels)
        counts.not_finite += found.not_finite
        counts.too_small += found.too_small
        counts.cut += found.cut
        if found.not_finite:
            self._note_fault(
                "not_finite",
                f"{picture.name}: the detector answered NaN or infinity for {found.not_finite:,} "
                "boxes, which are left out",
            )
        if found.cut:
            self._note_fault(
                "cut",
                f"{picture.name}: {found.cut:,} boxes too many, of which some may show the same"
                " thing; change --max-detections or --confidence to keep more or find fewer",
            )

    def _keyframe(
        self, picture: Picture, pixels: Pixels, pose: RobotPose | None, found: Found
    ) -> DetectedKeyframe:
        number = KeyframeId(FIRST_KEYFRAME + self.counts.keyframes - 1)
        cut_out = [_cut_out(pixels, box) for box in found.boxes]
        vectors = self._encoder.encode(cut_out) if cut_out else []
        missing = sum(vector is None for vector in vectors)
        if missing:
            self.counts.not_encoded += missing
            self._note_fault(
                "not_encoded",
                f"{picture.name}: the encoder answered NaN or zero for {missing:,} crops, which"
                " have no embedding",
            )
        ids = [default_det_id(self._run_id, number, index) for index in range(len(vectors))]
        detections = [
            self._detection(*each)
            for each in zip(ids, found.labels, found.scores, found.boxes, vectors, strict=True)
        ]
        envelope = {
            "run_id": self._run_id,
            "keyframe_id": number,
            "timestamp": round(picture.stamp_s, 6),
            **_pose_fields(pose),
            **self._camera_fields(pixels),
            "detections": detections,
        }
        crops = []
        if self._keep_crops:
            jpegs = [encode_jpeg(shrunk(pixels, CROP_SIDE)) for pixels in cut_out]
            crops = [CropJpeg(*each) for each in zip(ids, jpegs, strict=True)]
        return DetectedKeyframe(envelope, crops)

    def _detection(
        self,
        det_id: DetId,
        label: str,
        score: float,
        box: NDArray[np.float64],
        vector: NDArray[np.float32] | None,
    ) -> dict[str, Any]:
        fields: dict[str, Any] = {
            "det_id": det_id,
            "class": label,
            "confidence": round(score, 4),
            "bbox": [round(edge, 1) for edge in box.tolist()],
        }
        if vector is not None:
            fields |= {
                "embedding": base64.b64encode(vector.astype("<f4").tobytes()).decode("ascii"),
                "embedding_dim": len(vector),
                "embedding_model": self._encoder.name,
            }
        return fields

    def _camera_fields(self, pixels: Pixels) -> dict[str, Any]:
        if self._hfov_deg is None:
            return {}
        height, width = pixels.shape[:2]
        return {"camera": {"hfov_deg": self._hfov_deg, "width_px": width, "height_px": height}}

    def _note_fault(self, kind: str, text: str) -> None:
        times = self._noted[kind] = self._noted.get(kind, 0) + 1
        if times <= _MOST_NOTES:
            last = "; others like it are only counted" if times == _MOST_NOTES else ""
            self._note(text + last)


def _pose_fields(pose: RobotPose | None) -> dict[str, float]:
    if pose is None:
        return {}
    yaw = math.remainder(pose.yaw, math.tau)
    return {"map_x": round(pose.x, 6), "map_y": round(pose.y, 6), "map_yaw": round(yaw, 6)}


def crops_of_message(payload: bytes, boxes: Boxes) -> list[bytes | None]:
    """The JPEGs of boxes in the picture of a CompressedImage or Image in CDR, None for one without
    a pixel of it, and for all if one is no box. Raises BadMessage if the picture cannot be read."""
    edges = np.array(boxes, np.float64).reshape(-1, 4)
    if not np.isfinite(edges).all():  # validation will refuse the envelope
        return [None] * len(edges)
    try:
        pixels = picture_of(payload, "", 0.0).pixels()
        height, width = pixels.shape[:2]
        inside = np.clip(edges, 0.0, (width, height) * 2)
        return [
            encode_jpeg(shrunk(_cut_out(pixels, box), CROP_SIDE))
            if (box[2:] - box[:2]).min() > 0.0
            else None
            for box in inside
        ]
    except (MessageError, PictureError) as error:
        raise BadMessage(str(error)) from None


def _cut_out(pixels: Pixels, box: NDArray[np.float64]) -> Pixels:
    """The pixels that a box touches."""
    x0, y0 = (int(edge) for edge in np.floor(box[:2]))
    x1, y1 = (int(edge) for edge in np.ceil(box[2:]))
    return pixels[y0:y1, x0:x1]
