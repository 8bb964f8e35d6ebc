"""A `MapView` as columns, and back. What the semantic map's own state says is not said again."""

from typing import Any

import numpy as np

from projections.deltas import Pose
from projections.records import (
    KeyframeRecord,
    ObjectRecord,
    ObservationRecord,
    PlaceRecord,
    RunRecord,
)
from projections.view import MapView

State = dict[str, Any]
_NONE = -1


def dump_view(view: MapView) -> State:
    """Everything but settings and embeddings."""
    return {
        "next_offset": view.next_offset,
        "skipped": view.skipped,
        "runs": [[r.run_id, r.started_at, r.keyframe_count] for r in view.runs],
        "adjacency": view.edges(),
        **_dump_keyframes(view),
        **_dump_observations(view),
        "objects": [
            [o.object_id, o.class_name, o.obs_count, o.sum_x_um, o.sum_y_um, o.place]
            for o in view.objects
        ],
        "object_times": _floats([(o.first_seen, o.last_seen) for o in view.objects], 2),
        "places": [
            [
                p.place_id,
                p.founder,
                p.founded_offset,
                p.keyframe_count,
                p.sum_x_um,
                p.sum_y_um,
                p.current().ordinal,
            ]
            for p in view.all_places
        ],
    }


def load_view(view: MapView, state: State) -> None:
    """Fill a new view with what `dump_view` gave."""
    view.next_offset = state["next_offset"]
    view.skipped = state["skipped"]
    view.runs = [RunRecord(i, *row) for i, row in enumerate(state["runs"])]
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
    return {
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
    for ordinal, ((offset, run, keyframe_id, place), timestamp) in enumerate(rows):
        run_id = view.runs[run].run_id
        pose = poses.get(ordinal)
        record = KeyframeRecord(ordinal, offset, run, run_id, keyframe_id, timestamp, pose)
        if place != _NONE:
            record.joined = view.all_places[place]
            record.joined.unordered_members.append(ordinal)
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
    for ordinal, (det_id, row, (confidence, *box)) in enumerate(rows):
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
        seer = view.keyframes[keyframe]
        seer.observations = [*seer.observations, ordinal]
        if fused != _NONE:
            record.object, record.similarity_q40 = fused, q40
            view.objects[fused].observations.append(ordinal)


def _load_objects(view: MapView, state: State) -> None:
    rows = zip(state["objects"], state["object_times"].tolist(), strict=True)
    for ordinal, ((object_id, name, count, x_um, y_um, place), (first, last)) in enumerate(rows):
        view.objects.append(
            ObjectRecord(ordinal, object_id, name, count, x_um, y_um, first, last, place)
        )


def _load_places(view: MapView, rows: list[list[Any]]) -> None:
    view.all_places = [PlaceRecord(i, *row[:-1]) for i, row in enumerate(rows)]
    for place, row in zip(view.all_places, rows, strict=True):
        if row[-1] == place.ordinal:
            view.places[place.ordinal] = place
        else:
            place.survivor = view.all_places[row[-1]]
