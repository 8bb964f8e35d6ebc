"""Runs of the simulated house as a poorer robot would see it: labels flicker, poses are noisy.

So fusion by evidence has something to do in tests: things are found twice and merged later, and
their class is another one than at first.
"""

from collections.abc import Collection
from functools import cache
from typing import Any

import numpy as np

from eventsrc.adapters.sim import simulate_run


@cache
def _run(name: str) -> tuple[dict[str, Any], ...]:
    return simulate_run(7, name).envelopes


def flickering_house(
    name: str,
    count: int,
    *,
    seed: int = 0,
    noise_m: float = 0.3,
    without: Collection[str] = (),
) -> list[dict[str, Any]]:
    """The first ``count`` keyframes of the run ``name``; a fifth of their labels are of another
    class of the house. Things of the classes ``without`` were carried away before."""
    rng = np.random.default_rng([seed, ord(name)])
    classes = sorted({d["class"] for envelope in _run(name) for d in envelope["detections"]})
    documents = []
    for envelope in _run(name):
        x, y, turn = rng.normal(size=3).tolist()
        detections = [
            {**seen, "class": classes[int(rng.integers(len(classes)))]}
            if rng.random() < 0.2
            else seen
            for seen in envelope["detections"]
            if seen["class"] not in without
        ]
        documents.append(
            {
                **envelope,
                "map_x": envelope["map_x"] + noise_m * x,
                "map_y": envelope["map_y"] + noise_m * y,
                "map_yaw": envelope["map_yaw"] + 0.05 * turn,
                "detections": detections,
            }
        )
    return documents[:count]
