"""A synthetic log of a given size: a robot on a random walk that sees three things."""

import base64
import json
from pathlib import Path

import numpy as np

from eventsrc.log import NEVER, LogWriter
from eventsrc.record.append import append_payload

MODEL = "ViT-B-32/laion2b_s34b_b79k"
CLASSES = 40
DIM = 512
KEY = "tb/detections"


class World:
    """Makes envelopes 0, 1, 2 …; the same for the same seed. Area grows with the path."""

    def __init__(self, seed: int = 7, detections: int = 3) -> None:
        self._rng = np.random.default_rng(seed)
        self._classes = self._rng.normal(size=(CLASSES, DIM))
        self._detections = detections

    def payload(self, keyframe: int) -> bytes:
        """The envelope's bytes; call in order."""
        turn = keyframe * 0.05
        seen = [self._detection() for _ in range(self._detections)]
        document = {
            "run_id": f"robot-{keyframe // 2000}",
            "keyframe_id": keyframe,
            "timestamp": 1_774_357_200.0 + keyframe * 0.5,
            "map_x": float(8 * np.cos(turn * 0.7) + turn * 0.2),
            "map_y": float(8 * np.sin(turn * 0.45) + turn * 0.1),
            "map_yaw": 0.1,
            "detections": seen,
        }
        return json.dumps(document).encode()

    def _detection(self) -> dict[str, object]:
        k = int(self._rng.integers(CLASSES))
        vector = self._classes[k] + 0.6 * self._rng.normal(size=DIM)
        return {
            "class": f"class {k}",
            "confidence": 0.87,
            "bbox": [120.0, 80.0, 250.0, 310.0],
            "embedding": base64.b64encode(vector.astype("<f4").tobytes()).decode(),
            "embedding_dim": DIM,
            "embedding_model": MODEL,
        }


def make_log(path: Path, keyframes: int, *, seed: int = 7) -> Path:
    """Write a log of so many keyframes, if it is not there yet."""
    if not path.exists():
        world = World(seed)
        with LogWriter(path, fsync=NEVER) as writer:
            for k in range(keyframes):
                append_payload(writer, KEY, world.payload(k))
    return path
