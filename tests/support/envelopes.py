"""Envelopes for tests, made as a robot would make them: plain dictionaries, encoded to JSON."""

import base64
import json
from typing import Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike
from pydantic import BaseModel

MODEL = "ViT-B-32/laion2b_s34b_b79k"


def embedding(values: ArrayLike) -> dict[str, Any]:
    """The three embedding fields of a detection."""
    vector = np.asarray(values, dtype="<f4")
    return {
        "embedding": base64.b64encode(vector.tobytes()).decode(),
        "embedding_dim": int(vector.size),
        "embedding_model": MODEL,
    }


def detection(
    class_name: str = "cup", vector: ArrayLike | None = None, **fields: Any
) -> dict[str, Any]:
    """One detection, with an embedding when ``vector`` is given."""
    base = {"class": class_name, "confidence": 0.87, "bbox": [120.0, 80.0, 250.0, 310.0]}
    return {**base, **(embedding(vector) if vector is not None else {}), **fields}


def envelope(
    keyframe_id: int = 1, x: float | None = 0.0, y: float | None = 0.0, **fields: Any
) -> dict[str, Any]:
    """One envelope; without a pose when ``x`` is None."""
    base: dict[str, Any] = {
        "run_id": "run-a",
        "keyframe_id": keyframe_id,
        "timestamp": 1774357200.0 + keyframe_id,
        "detections": [],
    }
    if x is not None:
        base |= {"map_x": x, "map_y": y, "map_yaw": 0.0}
    return {**base, **fields}


def payload(document: Any) -> bytes:
    """The bytes that go over the wire."""
    return json.dumps(document, ensure_ascii=False).encode()


def fields_of(whole: object) -> Any:
    """Names and values, to the last bit, of an envelope and of what is in it, model or not."""
    if isinstance(whole, tuple):
        return [fields_of(each) for each in whole]
    if isinstance(whole, BaseModel):
        return {name: fields_of(getattr(whole, name)) for name in type(whole).model_fields}
    if isinstance(whole, msgspec.Struct):
        return {name: fields_of(getattr(whole, name)) for name in whole.__struct_fields__}
    return repr(whole)


def keyframe_payloads(*keyframe_ids: int, **fields: object) -> list[bytes]:
    """An envelope for each id."""
    return [payload(envelope(k, **fields)) for k in keyframe_ids]
