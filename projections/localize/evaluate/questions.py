"""Questions for the evaluation, one from each query keyframe with enough crops; repeatable.

Which crops of a keyframe are asked with is drawn by hashing ``seed`` and each det_id; the one-crop
question's crop is among the two-crop question's, and so on. The truth only scores the answer.

A question of several views has the keyframe and those before it in its run, and how the robot moved
between them by the poses that it reported.
"""

import hashlib
import sys
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeVar

from eventsrc.base.errors import MisuseError
from eventsrc.envelope.ingest import Accepted, ingest
from eventsrc.envelope.model import StatedCamera
from eventsrc.log import LogReader
from eventsrc.log.reader import OnGap
from projections.fold.corrections import Corrections
from projections.fold.edited_events import Reembedded, relabelled
from projections.fold.exact import metres_to_um
from projections.fold.floors import floor_name
from projections.fold.settings import CameraSettings, Settings
from projections.fold.sights import camera_of
from projections.localize import relocalize
from projections.localize.relocalize import QuestionCrop, QuestionView
from projections.localize.relocalize.waking_robot import crop_of, moved_between, pose_of
from projections.map.parsing import read_corrections, vectors_of

from .truth import Key, Truth

DEFAULT_SEED = 20260321
FLOOR_HEIGHT_M: Final = Settings().floor_height_m


T = TypeVar("T")
VIEW_CROPS = 3
"""The most crops of a view."""
_NEAR_BY = 4
"""The views of a question are among its last keyframes, this number times the number of views."""


@dataclass(frozen=True, slots=True)
class ScoredQuestion:
    """A question with its true pose, room, instances and floor; pose, room, floor and key are those
    of the last view. ``floor`` is None where its keyframe states none."""

    key: Key
    asked: relocalize.Question
    x: float
    y: float
    yaw: float
    room: str | None
    instances: tuple[str | None, ...]
    floor: str | None = None

    @property
    def crops(self) -> tuple[QuestionCrop, ...]:
        """The crops of all views."""
        return self.asked.crops


def read_keyframes(
    logs: Iterable[Path],
    settings: Settings | None = None,
    on_gap: OnGap | None = None,
    corrections: Corrections | None = None,
) -> Iterator[Accepted]:
    """Every valid keyframe of the logs with a pose, each (run, keyframe) once, with its log's names
    of classes; where the settings name a space, with the vectors of that space alone, also those
    given later. ``corrections`` are those of the logs, by default of all commands of each. Raises
    LogDamaged, or calls ``on_gap``, for damage."""
    model = None if settings is None else settings.embedding_model
    seen: set[Key] = set()
    for log in logs:
        with LogReader(log) as reader:
            later, obeyed = None, corrections or read_corrections(reader)
            if settings is not None and model is not None:
                later = vectors_of(reader, settings, obeyed)
            for event in reader.read(on_gap=on_gap):
                if not event.is_envelope:
                    continue
                found = ingest(event.payload, max_bytes=sys.maxsize)
                if not isinstance(found, Accepted) or found.envelope.map_x is None:
                    continue
                key = (found.envelope.run_id, found.envelope.keyframe_id)
                if key not in seen:
                    seen.add(key)
                    found = relabelled(found, obeyed.labels)
                    yield found if model is None else _in_space(found, model, later)


def _in_space(keyframe: Accepted, model: str, later: Reembedded | None) -> Accepted:
    """A keyframe with the vectors of one model, and those of ``later``."""
    if later is not None:
        keyframe, _ = later.applied(keyframe, [None] * len(keyframe.vectors))
    detections = keyframe.envelope.detections
    vectors = tuple(
        vector if detection.embedding_model == model else None
        for detection, vector in zip(detections, keyframe.vectors, strict=True)
    )
    return Accepted(keyframe.envelope, keyframe.det_ids, vectors)


def make_questions(
    keyframes: Sequence[Accepted],
    truth: Truth,
    crops: int,
    seed: int = DEFAULT_SEED,
    floor_height_m: float = FLOOR_HEIGHT_M,
) -> list[ScoredQuestion]:
    """One question of ``crops`` crops from each keyframe that has truth and as many embeddings; as
    many detections where no keyframe has an embedding. ``floor_height_m`` is that of the map's
    settings."""
    found = []
    bare = _are_bare(keyframes)
    for keyframe in keyframes:
        drawn = _draw(keyframe, crops, seed, bare)
        if _key(keyframe) in truth.keyframes and len(drawn) == crops:
            found.append(_question([(keyframe, drawn)], truth, floor_height_m))
    return found


def make_view_questions(
    keyframes: Sequence[Accepted],
    truth: Truth,
    views: int,
    seed: int = DEFAULT_SEED,
    floor_height_m: float = FLOOR_HEIGHT_M,
) -> list[ScoredQuestion]:
    """One question from each keyframe that has truth and an embedding: it and the keyframes before
    it that have embeddings, ``views`` in all, of up to `VIEW_CROPS` crops each, by one camera.
    Where no keyframe has an embedding detections do.

    None from one before which there are too few within 4 · ``views`` keyframes of its run.
    """
    found: list[ScoredQuestion] = []
    recent: deque[tuple[int, Accepted, list[int]]] = deque(maxlen=views)
    bare = _are_bare(keyframes)
    for number, keyframe in enumerate(keyframes):
        if recent and _taken_by(recent[-1][1]) != _taken_by(keyframe):
            recent.clear()
        drawn = _draw(keyframe, VIEW_CROPS, seed, bare)
        if not drawn or _key(keyframe) not in truth.keyframes:
            continue
        recent.append((number, keyframe, drawn))
        if len(recent) == views and number - recent[0][0] < _NEAR_BY * views:
            shown = [(each, crops) for _, each, crops in recent]
            found.append(_question(shown, truth, floor_height_m))
    return found


def spread(items: Sequence[T], most: int) -> list[T]:
    """``most`` of the items, evenly; all if there are no more."""
    if len(items) <= most:
        return list(items)
    return [items[i * len(items) // most] for i in range(most)]


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


def _taken_by(keyframe: Accepted) -> tuple[str, StatedCamera | None]:
    """The run, and the camera as its envelope states it."""
    return keyframe.envelope.run_id, keyframe.envelope.camera


def _key(keyframe: Accepted) -> Key:
    return keyframe.envelope.run_id, keyframe.envelope.keyframe_id


def _are_bare(keyframes: Iterable[Accepted]) -> bool:
    """Whether no detection has an embedding, of whatever space."""
    return all(
        vector is None and detection.embedding_model is None
        for keyframe in keyframes
        for vector, detection in zip(keyframe.vectors, keyframe.envelope.detections, strict=True)
    )


def _draw(keyframe: Accepted, most: int, seed: int, bare: bool) -> list[int]:
    """Up to ``most`` of the detections that have an embedding, of all if they are ``bare``."""
    usable = [i for i, vector in enumerate(keyframe.vectors) if bare or vector is not None]
    return sorted(usable, key=lambda i: draw_key(seed, keyframe.det_ids[i]))[:most]


def draw_key(seed: int, det_id: str) -> bytes:
    """A key that orders the crops of a keyframe; questions have the first ones."""
    return hashlib.sha256(f"{seed}:{det_id}".encode()).digest()


def floor_of(keyframe: Accepted, floor_height_m: float) -> str | None:
    """The floor that a keyframe states, as the fold names it; None if it states none."""
    return floor_name(keyframe.envelope, metres_to_um(floor_height_m))


def _question(
    drawn: Sequence[tuple[Accepted, Sequence[int]]], truth: Truth, floor_height_m: float
) -> ScoredQuestion:
    views = []
    before = drawn[0][0]
    for keyframe, indices in drawn:
        crops = tuple(crop_of(keyframe, index) for index in indices)
        views.append(QuestionView(*moved_between(pose_of(before), pose_of(keyframe)), crops))
        before = keyframe
    key, stated = _key(before), before.envelope.camera
    camera = None if stated is None else camera_of(stated, CameraSettings())
    return ScoredQuestion(
        key,
        relocalize.Question(tuple(views), camera),
        *pose_of(before),
        truth.room(key),
        tuple(truth.instance(_key(k), index) for k, indices in drawn for index in indices),
        floor_of(before, floor_height_m),
    )
