"""Ids folded so far: runs, keyframes with a digest of their content, det_ids.

A ``(run_id, keyframe_id)`` met again is a *duplicate* if its content is the same and a *conflict*
if not. Content is compared after parsing: key order, white space and unknown fields do not matter,
and an id written out equals the same id by default.
"""

import hashlib
import marshal
from collections.abc import MutableSequence
from operator import attrgetter
from typing import Any

import numpy as np
from msgspec.structs import astuple

from eventsrc.base.machine import crc32
from eventsrc.envelope.ingest import Accepted
from eventsrc.envelope.model import (
    Detection,
    DetId,
    KeyframeId,
    Offset,
    RunId,
    has_evidence,
    has_floor,
)

from . import State, packed
from .deltas import KeyframeOrdinal, RunOrdinal

_DIGEST_BYTES = 16
_detection_content = attrgetter("class_name", "confidence", "bbox", "embedding_model")


def content_digest(accepted: Accepted) -> bytes:
    """16 bytes that are equal for envelopes of equal content, and else differ.

    Vectors enter by a 32-bit checksum: hashing all their bytes would cost a tenth of the fold, to
    tell a conflict from a duplicate in the one of 4 billion that differs in nothing but a vector.
    """
    if accepted.digest is not None:
        return accepted.digest
    envelope, checksum = accepted.envelope, 0
    lengths: list[int | None] = []
    for vector in accepted.vectors:
        if vector is None:
            lengths.append(None)
        else:
            checksum = crc32(vector.data, checksum)
            lengths.append(len(vector))
    content: Any = (
        (envelope.timestamp, envelope.map_x, envelope.map_y, envelope.map_yaw),
        accepted.det_ids,
        [*map(_detection_content, envelope.detections)],
        lengths,
        checksum,
    )
    if has_evidence(envelope):
        camera = envelope.camera
        content += (
            camera and (camera.hfov_deg, camera.width_px, camera.height_px, camera.yaw_rad),
            [*map(_evidence, envelope.detections)],
        )
    if has_floor(envelope):
        content += (envelope.floor, envelope.map_z)
    if envelope.pose_covariance is not None:
        content += (("pose_covariance", *envelope.pose_covariance),)
    if envelope.scan is not None:
        content += (("scan", *astuple(envelope.scan)),)
    if envelope.frame is not None:
        content += (("frame", envelope.frame),)
    if any(d.position_z is not None or d.size is not None for d in envelope.detections):
        content += (("bodies", *((d.position_z, d.size) for d in envelope.detections)),)
    # Format version 2 has no references, so equal values give equal bytes.
    return hashlib.blake2b(marshal.dumps(content, 2), digest_size=_DIGEST_BYTES).digest()


def _evidence(detection: Detection) -> tuple[object, ...]:
    depth, position = detection.depth_m, detection.position
    return (
        depth and (depth, detection.depth_sigma_m),
        position and (position, detection.position_sigma_m),
    )


class FoldedIds:
    """Runs, keyframes and det_ids folded so far, and the ordinals of the first two."""

    def __init__(self) -> None:
        self.runs: dict[RunId, RunOrdinal] = {}
        self.started: list[float] = []  # per run
        self.keyframes: list[dict[KeyframeId, KeyframeOrdinal]] = []  # per run
        # Per keyframe:
        self.keyframe_ids: MutableSequence[KeyframeId] = packed("q")
        self.run_of: MutableSequence[RunOrdinal] = packed("i")
        self.offsets: MutableSequence[Offset] = packed("q")
        self.digests = bytearray()
        self.det_ids: dict[DetId, KeyframeOrdinal] = {}  # det_id → keyframe, in order of arrival

    def add_run(self, run_id: RunId, timestamp: float) -> tuple[RunOrdinal, bool]:
        """The run's ordinal, and whether it is new or turns out to have started earlier."""
        run = self.runs.get(run_id)
        if run is None:
            run = self.runs[run_id] = RunOrdinal(len(self.runs))
            self.started.append(timestamp)
            self.keyframes.append({})
            return run, True
        if timestamp < self.started[run]:
            self.started[run] = timestamp
            return run, True
        return run, False

    def find(self, run_id: RunId, keyframe_id: KeyframeId) -> KeyframeOrdinal | None:
        """The ordinal of a keyframe that was folded, else None."""
        run = self.runs.get(run_id)
        return None if run is None else self.keyframes[run].get(keyframe_id)

    def add_keyframe(
        self, run: RunOrdinal, keyframe_id: KeyframeId, offset: Offset, digest: bytes
    ) -> KeyframeOrdinal:
        """Number a new keyframe."""
        keyframe = KeyframeOrdinal(len(self.offsets))
        self.keyframes[run][keyframe_id] = keyframe
        self.keyframe_ids.append(keyframe_id)
        self.run_of.append(run)
        self.offsets.append(offset)
        self.digests += digest
        return keyframe

    def digest_of(self, keyframe: KeyframeOrdinal) -> bytes:
        """The content digest of a folded keyframe."""
        start = keyframe * _DIGEST_BYTES
        return bytes(self.digests[start : start + _DIGEST_BYTES])

    def dump(self) -> State:
        """The whole state, to be kept."""
        return {
            "runs": list(self.runs),
            "started": self.started,
            "keyframe_ids": np.array(self.keyframe_ids, np.int64),
            "run_of": np.array(self.run_of, np.int32),
            "offsets": np.array(self.offsets, np.int64),
            "digests": np.frombuffer(bytes(self.digests), np.uint8),
            "det_ids": list(self.det_ids),
            "det_keyframes": np.array(list(self.det_ids.values()), np.int32),
        }

    def load(self, state: State) -> None:
        """Restore the state of `dump`."""
        self.runs = {run_id: RunOrdinal(run) for run, run_id in enumerate(state["runs"])}
        self.started = state["started"]
        self.keyframe_ids = packed("q", state["keyframe_ids"].tobytes())
        self.run_of = packed("i", state["run_of"].tobytes())
        self.offsets = packed("q", state["offsets"].tobytes())
        self.digests = bytearray(state["digests"].tobytes())
        self.det_ids = dict(zip(state["det_ids"], state["det_keyframes"].tolist(), strict=True))
        self.keyframes = [{} for _ in self.runs]
        for keyframe, (run, keyframe_id) in enumerate(
            zip(self.run_of, self.keyframe_ids, strict=True)
        ):
            self.keyframes[run][keyframe_id] = KeyframeOrdinal(keyframe)
