"""Snapshots: a fold and its view as bytes, and back. Reading one never runs code from it.

    magic · SHA-256 of all that follows · zlib of (length of the index, index, arrays end to end)

The index is JSON: the JSON values, and for each numpy array its dtype, shape and position.
Only plain number types are read; anything else is refused.
docs/decisions/snapshot-container.md says why this is not `numpy.savez`.
"""

import hashlib
import json
import math
import zlib
from collections.abc import Callable, Sequence
from dataclasses import astuple
from typing import Any

import numpy as np

from eventsrc.log import same_but_sealed
from projections.fold import State, part, prefixed
from projections.fold.corrections import NO_CORRECTIONS, Corrections, map_fingerprint
from projections.fold.deltas import (
    KeyframeOrdinal,
    ObjectOrdinal,
    ObservationOrdinal,
    PlaceOrdinal,
    Pose,
    RunOrdinal,
)
from projections.fold.semantic_map import SemanticMap
from projections.fold.settings import Settings

from .records import (
    Estimate,
    KeyframeRecord,
    ObjectRecord,
    ObservationRecord,
    PlaceRecord,
    Relocation,
    RunRecord,
)
from .view import MapView

MAGIC = b"mapfold snapshot 1\n"
_TYPES = frozenset({"<i2", "<i4", "<i8", "<f4", "<f8", "|u1", "<u4", "|i1"})
_LENGTH_BYTES = 8
_MAX_RATIO = 16
_ALWAYS_ALLOWED_BYTES = 64 * 1024 * 1024
"""A snapshot that decompresses to more than this, and to more than `_MAX_RATIO` times its size, is
refused. Those measured decompress to four times their size."""
_NONE = -1
"""The value for None in the packed columns of a view."""


class MalformedSnapshot(ValueError):
    """Raised for bytes that are no snapshot of this version, or a damaged one; the message says
    how."""


def pack(values: State) -> bytes:
    """Arrays and JSON values by name as bytes. Raises TypeError for an array of another type."""
    plain: dict[str, Any] = {}
    arrays: dict[str, tuple[str, tuple[int, ...], int]] = {}
    blobs: list[bytes] = []
    at = 0
    for name, value in values.items():
        if not isinstance(value, np.ndarray):
            plain[name] = value
            continue
        little = value.astype(value.dtype.newbyteorder("<"), copy=False)
        if little.dtype.str not in _TYPES:
            raise TypeError(f"{name} is an array of {little.dtype.str}, which no snapshot holds")
        blobs.append(little.tobytes())
        arrays[name] = (little.dtype.str, little.shape, at)
        at += len(blobs[-1])
    index = json.dumps({"plain": plain, "arrays": arrays}, allow_nan=False).encode()
    body = zlib.compress(b"".join([len(index).to_bytes(_LENGTH_BYTES, "little"), index, *blobs]), 1)
    return MAGIC + hashlib.sha256(body).digest() + body


def unpack(data: bytes) -> State:
    """The values of `pack`. Raises MalformedSnapshot."""
    head = len(MAGIC) + hashlib.sha256().digest_size
    if not data.startswith(MAGIC):
        raise MalformedSnapshot("it does not begin like a snapshot of this version")
    body = data[head:]
    if hashlib.sha256(body).digest() != data[len(MAGIC) : head]:
        raise MalformedSnapshot("its checksum does not match")
    content = _decompress(body)
    start = _LENGTH_BYTES + int.from_bytes(content[:_LENGTH_BYTES], "little")
    index = json.loads(content[_LENGTH_BYTES:start])
    values: State = index["plain"]
    for name, (dtype, shape, at) in index["arrays"].items():
        if dtype not in _TYPES:
            raise MalformedSnapshot(f"{name} is of the type {dtype!r}")
        flat = np.frombuffer(content, dtype, math.prod(shape), start + at)
        values[name] = flat.reshape(shape).copy()
    return values


def _decompress(body: bytes) -> bytes:
    """Decompress up to a limit: a forged snapshot has a right checksum, too."""
    limit = max(_ALWAYS_ALLOWED_BYTES, _MAX_RATIO * len(body))
    stream = zlib.decompressobj()
    content = stream.decompress(body, limit)
    if not stream.eof:
        raise MalformedSnapshot(f"it is cut off, or decompresses to more than {limit:,} bytes")
    return content


def dump_view(view: MapView) -> State:
    """A view as columns: everything but settings and embeddings."""
    return {
        "next_offset": view.next_offset,
        "skipped": view.skipped,
        "runs": [[r.run_id, r.started_at, r.keyframe_count] for r in view.runs],
        "adjacency": view.edges(),
        **_dump_keyframes(view),
        **_dump_observations(view),
        "objects": [
            [o.object_id, o.class_name, o.obs_count, o.sum_x_um, o.sum_y_um, o.place]
            for o in view.all_objects
        ],
        "object_times": _floats([(o.first_seen, o.last_seen) for o in view.all_objects], 2),
        "absorbed_objects": sorted(view.object_survivors.absorbed_by.items()),
        **_dump_evidence(view),
        "places": [
            [
                p.place_id,
                p.founder,
                p.founded_offset,
                p.keyframe_count,
                p.sum_x_um,
                p.sum_y_um,
                view.survivors.find(p.ordinal),
            ]
            for p in view.all_places
        ],
    }


def load_view(view: MapView, state: State) -> None:
    """Fill a new view with the columns of `dump_view`."""
    view.next_offset = state["next_offset"]
    view.skipped = state["skipped"]
    view.runs = [RunRecord(RunOrdinal(i), *row) for i, row in enumerate(state["runs"])]
    view.adjacency = {(a, b): n for a, b, n in state["adjacency"]}
    _load_places(view, state["places"])
    _load_keyframes(view, state)
    _load_objects(view, state)
    _load_observations(view, state)


def _floats(rows: list[Any], width: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.array(rows, np.float64).reshape(-1, width)


def _dump_keyframes(view: MapView) -> State:
    rows = [
        (k.offset, k.run, k.keyframe_id, _NONE if k.place is None else k.place)
        for k in view.keyframes
    ]
    poses = [(k.ordinal, k.pose.x_um, k.pose.y_um) for k in view.keyframes if k.pose is not None]
    yaws = [k.pose.yaw_rad for k in view.keyframes if k.pose is not None]
    floors = [_NONE if k.floor is None else view.floors[k.floor] for k in view.keyframes]
    return {
        "floors": list(view.floors),
        "keyframe_floors": np.array(floors if view.floors else (), np.int32),
        "keyframes": np.array(rows, np.int64).reshape(-1, 4),
        "timestamps": np.array([k.timestamp for k in view.keyframes], np.float64),
        "poses": np.array(poses, np.int64).reshape(-1, 3),
        "yaws": np.array(yaws, np.float64),
    }


def _load_keyframes(view: MapView, state: State) -> None:
    poses = {
        keyframe: Pose(x_um, y_um, yaw)
        for (keyframe, x_um, y_um), yaw in zip(
            state["poses"].tolist(), state["yaws"].tolist(), strict=True
        )
    }
    rows = zip(state["keyframes"].tolist(), state["timestamps"].tolist(), strict=True)
    names = state.get("floors", [])
    view.floors = {name: number for number, name in enumerate(names)}
    floors = state["keyframe_floors"].tolist() if names else ()
    for i, ((offset, run, keyframe_id, place), timestamp) in enumerate(rows):
        ordinal, run_id, pose = KeyframeOrdinal(i), view.runs[run].run_id, poses.get(i)
        record = KeyframeRecord(
            ordinal, offset, run, run_id, keyframe_id, timestamp, pose, view.survivors
        )
        if place != _NONE:
            record.joined = place
            view.all_places[place].unordered_members.append(ordinal)
        if names and floors[i] != _NONE:
            record.floor = names[floors[i]]
        view.keyframes.append(record)


def _dump_observations(view: MapView) -> State:
    names = sorted({o.class_name for o in view.observations})
    models = sorted({o.embedding_model or "" for o in view.observations})
    name_at = {name: i for i, name in enumerate(names)}
    model_at = {model: i for i, model in enumerate(models)}
    rows = [
        (
            o.keyframe,
            name_at[o.class_name],
            _NONE if o.embedding_model is None else model_at[o.embedding_model],
            _NONE if o.embedding_crc is None else o.embedding_crc,
            o.foreign_space,
            _NONE if o.object is None else o.object,
            _NONE if o.similarity_q40 is None else o.similarity_q40,
        )
        for o in view.observations
    ]
    return {
        "class_names": names,
        "models": models,
        "det_ids": [o.det_id for o in view.observations],
        "observations": np.array(rows, np.int64).reshape(-1, 7),
        "boxes": _floats([(o.confidence, *o.bbox) for o in view.observations], 5),
    }


def _load_observations(view: MapView, state: State) -> None:
    names, models = state["class_names"], state["models"]
    rows = zip(
        state["det_ids"], state["observations"].tolist(), state["boxes"].tolist(), strict=True
    )
    for i, (det_id, row, (confidence, *box)) in enumerate(rows):
        ordinal = ObservationOrdinal(i)
        keyframe, name, model, crc, is_foreign, fused, q40 = row
        record = ObservationRecord(
            ordinal,
            keyframe,
            det_id,
            names[name],
            confidence,
            (box[0], box[1], box[2], box[3]),
            None if model == _NONE else models[model],
            None,
            None if crc == _NONE else crc,
            bool(is_foreign),
        )
        view.observations.append(record)
        observer = view.keyframes[keyframe]
        observer.observations = [*observer.observations, ordinal]
        if fused != _NONE:
            record.object, record.similarity_q40 = fused, q40
            view.all_objects[fused].observations.append(ordinal)


def _load_objects(view: MapView, state: State) -> None:
    rows = zip(state["objects"], state["object_times"].tolist(), strict=True)
    for i, ((object_id, name, count, x_um, y_um, place), (first, last)) in enumerate(rows):
        ordinal = ObjectOrdinal(i)
        view.all_objects.append(
            ObjectRecord(ordinal, object_id, name, count, x_um, y_um, first, last, place)
        )
    for absorbed, survivor in state.get("absorbed_objects", ()):
        view.object_survivors.merge(survivor, (absorbed,))
    absorbed_by = view.object_survivors.absorbed_by
    view.objects = {o.ordinal: o for o in view.all_objects if o.ordinal not in absorbed_by}
    if view.settings.fusion == "evidence":
        _load_evidence(view, state)
    for found in view.objects.values():
        view.contents.update(found)


def _dump_evidence(view: MapView) -> State:
    """Facts of fusion by evidence about Objects; nothing under ``fusion = "page"``."""
    if view.settings.fusion != "evidence":
        return {}
    return {
        "estimates": [
            [o.ordinal, *astuple(o.estimate)] for o in view.all_objects if o.estimate is not None
        ],
        "presence": [[o.misses, o.missing_in] for o in view.all_objects],
        "relocations": [[o.ordinal, *astuple(r)] for o in view.all_objects for r in o.relocations],
    }


def _load_evidence(view: MapView, state: State) -> None:
    objects = view.all_objects
    for ordinal, *estimate in state["estimates"]:
        objects[ordinal].estimate = Estimate(*estimate)
    for record, (misses, missing_in) in zip(objects, state["presence"], strict=True):
        record.misses, record.missing_in = misses, missing_in
    for ordinal, *relocation in state["relocations"]:
        objects[ordinal].relocations.append(Relocation(*relocation))


def _load_places(view: MapView, rows: list[list[Any]]) -> None:
    for i, (*row, survivor) in enumerate(rows):
        place = PlaceRecord(PlaceOrdinal(i), *row)
        view.all_places.append(place)
        if survivor == place.ordinal:
            view.places[place.ordinal] = place
        else:
            view.survivors.merge(survivor, (place.ordinal,))


FOLD_VERSION = 5
"""To be raised with every change of the reducers that changes the map of some log."""


def snapshot_fingerprint(settings: Settings, corrections: Corrections) -> str:
    """16 hex digits that are equal for maps whose snapshots are interchangeable: those that differ
    in names of places only."""
    return map_fingerprint(settings, corrections.without_names())


class SnapshotRefused(ValueError):
    """A snapshot cannot be used here; the message says why."""


def snapshot(
    semantic_map: SemanticMap, view: MapView, log_id: str, segments: Sequence[str] = ()
) -> bytes:
    """The bytes of a map and its view without embeddings, as of ``semantic_map.next_offset``.

    ``segments`` is the `eventsrc.log.segment_signatures` of the events they were folded from. Names
    of places are not in it: `restore` is given them, so it also holds under other names.
    """
    about = {
        "fold_version": FOLD_VERSION,
        "log_id": log_id,
        "segments": list(segments),
        "fingerprint": snapshot_fingerprint(semantic_map.settings, semantic_map.corrections),
        "offset": semantic_map.next_offset,
    }
    return pack(
        prefixed("about", about)
        | prefixed("map", semantic_map.dump())
        | prefixed("view", dump_view(view))
    )


def restore(
    data: bytes,
    settings: Settings,
    log_id: str,
    signatures_at: Callable[[int], Sequence[str]] = lambda _: (),
    *,
    corrections: Corrections = NO_CORRECTIONS,
) -> tuple[SemanticMap, MapView]:
    """The map and the view of a `snapshot`.

    ``signatures_at`` gives the log's `eventsrc.log.segment_signatures` up to an offset, as it is
    now. Raises SnapshotRefused, and what ``signatures_at`` raises.
    """
    semantic_map = SemanticMap(settings, corrections)
    view = MapView(settings, keep_embeddings=False, corrections=corrections)
    try:
        state = unpack(data)
        about = part("about", state)
        _check_identity(about, snapshot_fingerprint(settings, corrections), log_id)
        _check_signatures(about["segments"], signatures_at(about["offset"]))
        semantic_map.load(part("map", state))
        load_view(view, part("view", state))
        view.maps = dict(semantic_map.current_map.given)
        for delta in semantic_map.use_names(semantic_map.next_offset, corrections):
            view.apply(delta)
    except (MalformedSnapshot, zlib.error) as error:
        raise SnapshotRefused(str(error)) from None
    except SnapshotRefused:
        raise
    except (LookupError, TypeError, AttributeError, ValueError, OverflowError) as error:
        raise SnapshotRefused(f"its content does not fit together: {error!r}") from None
    return semantic_map, view


def _check_identity(about: dict[str, Any], fingerprint: str, log_id: str) -> None:
    if about["fold_version"] != FOLD_VERSION:
        raise SnapshotRefused(f"it is of fold version {about['fold_version']}, not {FOLD_VERSION}")
    if about["log_id"] != log_id:
        raise SnapshotRefused(f"it is of the log {about['log_id']}, not of {log_id}")
    if about["fingerprint"] != fingerprint:
        raise SnapshotRefused("it was made with other settings or under other corrections")


def _check_signatures(before: Sequence[str], now: Sequence[str]) -> None:
    if not same_but_sealed(before, now):
        raise SnapshotRefused("the log has lost events since it was made")
