"""Questions for the evaluation, one from each query keyframe with enough crops; repeatable.

Which crops of a keyframe are asked with is drawn by hashing ``seed`` and each det_id; the one-crop
question's crop is among the two-crop question's, and so on. The truth only scores the answer.
"""

import hashlib
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from eventsrc.errors import MisuseError
from eventsrc.ingest import Accepted, ingest
from eventsrc.log import LogReader
from eventsrc.system_events import is_system_key
from projections.exact import quantise, to_float32
from projections.relocalize import Crop

from .truth import Key, Truth

DEFAULT_SEED = 20260321


@dataclass(frozen=True, slots=True)
class Question:
    """Crops of one keyframe, and the true pose, room and instances behind them."""

    key: Key
    crops: tuple[Crop, ...]
    x: float
    y: float
    yaw: float
    room: str | None
    instances: tuple[str | None, ...]


def read_keyframes(logs: Iterable[Path]) -> Iterator[Accepted]:
    """Every valid keyframe of the logs with a pose, each (run, keyframe) once."""
    seen: set[Key] = set()
    for log in logs:
        with LogReader(log) as reader:
            for event in reader.read():
                if is_system_key(event.key):
                    continue
                found = ingest(event.payload, max_bytes=sys.maxsize)
                if not isinstance(found, Accepted) or found.envelope.map_x is None:
                    continue
                key = (found.envelope.run_id, found.envelope.keyframe_id)
                if key not in seen:
                    seen.add(key)
                    yield found


def make_questions(
    keyframes: Iterable[Accepted], truth: Truth, crops: int, seed: int = DEFAULT_SEED
) -> list[Question]:
    """One question of ``crops`` crops from each keyframe that has truth and as many embeddings."""
    found = []
    for keyframe in keyframes:
        key = (keyframe.envelope.run_id, keyframe.envelope.keyframe_id)
        usable = [i for i, vector in enumerate(keyframe.vectors) if vector is not None]
        if key in truth.keyframes and len(usable) >= crops:
            drawn = sorted(usable, key=lambda i: _draw_key(seed, keyframe.det_ids[i]))[:crops]
            found.append(_question(keyframe, key, truth, drawn))
    return found


def check_truth(keyframes: Iterable[Accepted], truth: Truth) -> None:
    """Raise MisuseError when no keyframe of the query logs has truth: nothing could be scored."""
    runs = set()
    for keyframe in keyframes:
        runs.add(keyframe.envelope.run_id)
        if (keyframe.envelope.run_id, keyframe.envelope.keyframe_id) in truth.keyframes:
            return
    raise MisuseError(
        f"no truth for any query keyframe of {', '.join(sorted(runs)) or 'any run'}; give the"
        " runs' truth files with --truth"
    )


def _draw_key(seed: int, det_id: str) -> bytes:
    return hashlib.sha256(f"{seed}:{det_id}".encode()).digest()


def _question(keyframe: Accepted, key: Key, truth: Truth, drawn: list[int]) -> Question:
    envelope = keyframe.envelope
    return Question(
        key,
        tuple(_crop(keyframe, index) for index in drawn),
        envelope.map_x or 0.0,
        envelope.map_y or 0.0,
        envelope.map_yaw or 0.0,
        truth.room(key),
        tuple(truth.instance(key, index) for index in drawn),
    )


def _crop(keyframe: Accepted, index: int) -> Crop:
    detection, vector = keyframe.envelope.detections[index], keyframe.vectors[index]
    assert vector is not None  # noqa: S101 - drawn among those that have one
    return Crop(
        to_float32(quantise(vector)),
        detection.bbox,
        detection.class_name,
        keyframe.det_ids[index],
        detection.embedding_model,
    )
