"""Random logs of everything that a log may have: for what reads logs in another way than others."""

import random
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from eventsrc.envelope.system_events import MAP_KEY
from eventsrc.log import LogWriter, NewEvent, seal
from eventsrc.record.append import append_payload
from tests.support.commands_in_logs import append_to, forget_keyframes, keep_apart, name_place
from tests.support.envelopes import detection, envelope, payload
from tests.support.fixtures_log import BY_HAND
from tests.support.logs import KEY, WEIRD
from tests.support.maps import drawn_map
from tests.support.verbatim import mixed_event

DIMS = (8, 8, 8, 8, 3)


def write_random_log(path: Path, seed: int, count: int = 150) -> Path:
    """Segments, chunks and commits of random size; keyframes that come twice, with vectors of
    several dimensions or none, cameras, floors; refusals, commands, maps, verbatim messages, and
    envelopes of version 1."""
    rng = random.Random(seed)
    options: dict[str, Any] = {"rotate_events": rng.choice((20, 60, 10_000))}
    with (
        patch.object(seal, "CHUNK_BYTES", rng.choice((2_000, 20_000, seal.CHUNK_BYTES))),
        LogWriter(path, fsync=BY_HAND, **options) as writer,
    ):
        for number in range(count):
            _append(writer, rng, number)
            if rng.random() < 0.1:
                writer.sync()
    return path


def _append(writer: LogWriter, rng: random.Random, number: int) -> None:
    kind = rng.random()
    if kind < 0.80:
        document = _envelope(rng, number if rng.random() < 0.95 else rng.randrange(number + 1))
        append_payload(writer, KEY, payload(document), logged_ns=10**9 * number + 7)
    elif kind < 0.86:
        bad = (b"{", b"[1]", b"[]", payload(envelope(number, run_id="")), b'{"run_id": NaN}')
        append_payload(writer, KEY, rng.choice(bad))
    elif kind < 0.90:
        commands = (name_place(2, f"room {number}"), keep_apart(0, 9), forget_keyframes(4, 6))
        append_to(writer, rng.choice(commands))
    elif kind < 0.92:
        drawing = rng.choice(("##. ..# ?.#", "..# ### ..."))
        writer.append(MAP_KEY, drawn_map(drawing).encode())
    elif kind < 0.96:
        writer.append_all([mixed_event(4 * number + rng.randrange(3))])
    else:
        bare = [{"class_name": rng.choice(WEIRD), "confidence": 0.5, "bbox": [0.0, 0.0, 4.0, 4.0]}]
        writer.append_all([NewEvent("old/camera", payload(bare), number, number, 1)])


def _envelope(rng: random.Random, number: int) -> dict[str, Any]:
    fields: dict[str, Any] = {}
    if rng.random() < 0.2:
        fields["camera"] = {"hfov_deg": 70.0, "width_px": 640.0, "height_px": 480.0}
    if rng.random() < 0.2:
        fields |= {"floor": rng.choice((2, "attic"))}
    if rng.random() < 0.2:
        fields["pose_covariance"] = [0.01, 0, 0, 0, 0.02, 0, 0, 0, 0.001]
    if rng.random() < 0.2:
        fields["a field of others"] = {"nested": [1, "two", None]}
    x = None if rng.random() < 0.1 else 0.3 * number + rng.random()
    return envelope(
        number, x, rng.random(), detections=[_seen(rng) for _ in range(rng.randrange(5))], **fields
    )


def _seen(rng: random.Random) -> dict[str, Any]:
    fields: dict[str, Any] = {}
    if rng.random() < 0.2:
        fields |= {"depth_m": 2.5, "position": [rng.random(), 1.0]}
    if rng.random() < 0.1:
        fields["det_id"] = f"det {rng.randrange(10**6)}"
    which = rng.randrange(len(WEIRD))
    if rng.random() < 0.15:
        return detection(WEIRD[which], **fields)
    near = np.random.default_rng(which).normal(size=rng.choice(DIMS))
    return detection(WEIRD[which], near + rng.random() / 5, **fields)
