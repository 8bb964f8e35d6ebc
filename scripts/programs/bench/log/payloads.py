"""Envelopes of 9 kB, as three detections with 512 floats each make them."""

import base64
import json
import random
import struct

KEY = "tb/detections"
_DIM = 512


def template(rng: random.Random, detections: int = 3) -> tuple[bytes, bytes]:
    """What stands before and behind the keyframe id."""
    found = [
        {
            "class": "cup",
            "confidence": 0.87,
            "bbox": [120.0, 80.0, 250.0, 310.0],
            "embedding": base64.b64encode(
                struct.pack(f"<{_DIM}f", *(rng.gauss(0, 1) for _ in range(_DIM)))
            ).decode(),
            "embedding_dim": _DIM,
            "embedding_model": "ViT-B-32/laion2b_s34b_b79k",
        }
        for _ in range(detections)
    ]
    rest = {"run_id": "bench", "timestamp": 1774357200.0, "map_x": 1.0, "map_y": 2.0}
    text = json.dumps({"keyframe_id": 0, **rest, "map_yaw": 0.5, "detections": found}).encode()
    before, _, behind = text.partition(b"0")
    return before, behind


class Payloads:
    """Payload number i is the same in every process; neighbours differ in their vectors."""

    def __init__(self, detections: int = 3) -> None:
        rng = random.Random(9)
        self._templates = [template(rng, detections) for _ in range(64)]

    def __getitem__(self, number: int) -> bytes:
        before, behind = self._templates[number % len(self._templates)]
        return b"%s%d%s" % (before, number, behind)
