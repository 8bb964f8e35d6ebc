"""Logs that keep crops, and encoders of them whose vectors a test can work out."""

import hashlib
import random
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from eventsrc.adapters.reembedding import Vector
from eventsrc.envelope.crops import (
    CROP_ENCODING,
    CROP_SCHEMA,
    CROP_SCHEMA_ENCODING,
    CROP_SCHEMA_TEXT,
    Crop,
    encode_crop,
)
from eventsrc.envelope.model import DetId
from eventsrc.log import NEVER, LogWriter, MessageFormat
from eventsrc.record.append import append_payload
from tests.support.envelopes import detection, embedding, envelope, payload

KEY = "tb/detections"
TOPIC = "tb/crops"
FORMAT = MessageFormat(CROP_ENCODING, CROP_SCHEMA, CROP_SCHEMA_ENCODING, CROP_SCHEMA_TEXT)


def jpeg(thing: int, look: int) -> bytes:
    """Bytes that a test's encoder understands: a thing, and how it looked."""
    return b"\xff\xd8\xff" + f"{thing} {look}".encode() + b"\xff\xd9"


class Encoder:
    """A vector for each thing of `jpeg`, turned a little by its look; ``answers`` replaces the
    vectors of some JPEGs."""

    def __init__(
        self, space: str, dimension: int, answers: dict[bytes, Vector | str] | None = None
    ) -> None:
        self.space, self.dimension = space, dimension
        self.sha256 = hashlib.sha256(f"{space} {dimension}".encode()).hexdigest()
        self.answers = answers or {}
        self.calls = 0

    def encode(self, jpegs: Sequence[bytes]) -> list[Vector | str]:
        self.calls += 1
        return [self.answers.get(each, self.vector(each)) for each in jpegs]

    def vector(self, each: bytes) -> Vector:
        thing, look = each[3:-2].split()
        base, noise = self._drawn(thing), self._drawn(thing + b" " + look)
        return np.asarray(base + 0.3 * noise, np.float32)

    def _drawn(self, name: bytes) -> Any:
        seed = hashlib.sha256(self.space.encode() + name).digest()[:8]
        return np.random.default_rng(int.from_bytes(seed, "big")).normal(size=self.dimension)


def drive(seed: int, keyframes: int = 24) -> list[tuple[dict[str, Any], dict[str, bytes]]]:
    """Envelopes without vectors, and the JPEGs of their detections by det_id."""
    rng = random.Random(seed)
    made = []
    for k in range(keyframes):
        room = k * 3 // keyframes
        seen = [
            (f"k{k}d{i}", thing := rng.randrange(4) + 4 * room, jpeg(thing, rng.randrange(10**6)))
            for i in range(rng.randrange(4))
        ]
        found = [detection(f"class-{thing % 3}", det_id=det_id) for det_id, thing, _ in seen]
        where = 6.0 * room + rng.uniform(-1, 1), rng.uniform(-1, 1)
        made.append((envelope(k, *where, detections=found), {d: each for d, _, each in seen}))
    return made


def with_vectors(
    made: dict[str, Any], crops: dict[str, bytes], encoder: Encoder | None
) -> dict[str, Any]:
    """An envelope with a vector of ``encoder`` for each detection that has a crop."""
    if encoder is None:
        return made
    detections = []
    for each in made["detections"]:
        crop = crops.get(each["det_id"])
        own = {} if crop is None else embedding(encoder.vector(crop))
        named = {} if crop is None else {"embedding_model": encoder.space}
        detections.append(each | own | named)
    return {**made, "detections": detections}


def write(
    path: Path,
    made: Sequence[tuple[dict[str, Any], dict[str, bytes]]],
    encoder: Encoder | None,
) -> Path:
    """A log of envelopes with vectors of ``encoder``, each behind its crops."""
    with LogWriter(path, fsync=NEVER) as writer:
        for number, (document, crops) in enumerate(made):
            now = (number + 1) * 10**9
            for det_id, each in crops.items():
                add_crop(writer, det_id, each, now)
            full = with_vectors(document, crops, encoder)
            append_payload(writer, KEY, payload(full), logged_ns=now)
    return path


def add_crop(writer: LogWriter, det_id: str, each: bytes, now: int = 1) -> None:
    message = encode_crop(Crop(DetId(det_id), each), now)
    writer.append(TOPIC, message, logged_ns=now, form=FORMAT)
