"""Two short runs through four rooms, with names no query may take for its own text."""

import numpy as np

from tests.support.envelopes import detection, envelope, payload

CLASSES = [
    "baker's rack",
    "x'}) DETACH DELETE r //",
    "$$; drop table",
    '🪑 "quoted" \\ back',
    "$1 %s {}",
]
RUNS = ["x'}) DETACH DELETE r //", "run 🤖 $$; drop table \\' \""]
ROOMS = [(0.0, 0.0), (10.0, 0.0), (10.0, 10.0), (0.0, 10.0)]
DIM = 512


def _direction(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(DIM)


def awkward_payloads() -> list[bytes]:
    """Each run visits each room for four keyframes, sees one class a room, once has no pose."""
    payloads = []
    for run_index, run_id in enumerate(RUNS):
        keyframe_id = 0
        for room, (x, y) in enumerate(ROOMS):
            for step in range(4):
                keyframe_id += 1
                seen = _direction(room) + 0.3 * _direction(1000 * run_index + keyframe_id)
                payloads.append(
                    payload(
                        envelope(
                            keyframe_id,
                            x + 0.3 * step,
                            y,
                            run_id=run_id,
                            detections=[
                                detection(CLASSES[room], seen),
                                detection(CLASSES[4], det_id=f"{run_id}/{keyframe_id}/plain"),
                            ],
                        )
                    )
                )
        payloads.append(payload(envelope(keyframe_id + 1, None, run_id=run_id)))
    return payloads
