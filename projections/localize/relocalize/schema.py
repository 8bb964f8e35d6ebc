"""The JSON schema of questions, for people and generators of clients.

It states all checks of `reading`, except those that a schema cannot express: that embeddings are of
the map's space and classes those of its Objects, and that `MAX_CROPS` counts the crops of all views
together.
"""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from eventsrc.envelope.model import MAX_DIMENSION
from eventsrc.envelope.readers import EnvelopeCamera

from .question import MAX_CROPS, MAX_VIEWS
from .reading import CropModel, MovementModel

_NULL: Final = {"type": "null"}
_SEARCHABLE: Final = {
    "anyOf": [
        {"required": ["embedding"], "properties": {"embedding": {"type": ["string", "array"]}}},
        {"required": ["class"], "properties": {"class": {"type": "string"}}},
    ]
}
"""The schema of a crop with an embedding or a class."""
_SIGN: Final = "[A-Za-z0-9+/]"
_EMBEDDING_TEXT: Final = {
    "type": "string",
    "contentEncoding": "base64",
    "pattern": f"^({_SIGN}{{16}})*({_SIGN}{{16}}|{_SIGN}{{11}}=|{_SIGN}{{6}}==)$",
    "description": "base64 of little-endian float32",
}


def question_schema(options: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """The schema; ``options`` are properties that the answering side reads beside those of the
    question."""
    crops = _crops_schema() | {"minItems": 1, "contains": _SEARCHABLE}
    camera = EnvelopeCamera.model_json_schema()
    common = {"camera": {"anyOf": [camera, {"type": "null"}]}, **(options or {})}
    movement = MovementModel.model_json_schema()["properties"]
    moved = {
        key: {**value, "description": "Since the previous question; only read with a session."}
        for key, value in movement.items()
    }
    together = {key: [other for other in moved if other != key] for key in moved}
    one_picture = {"not": {"required": ["views"]}, "dependentRequired": together}
    not_list = {"not": {"type": "array"}}
    return {
        "title": "Question",
        "anyOf": [
            {
                "type": "object",
                "properties": {"crops": crops, **moved, **common},
                "required": ["crops"],
                "allOf": [one_picture, {"properties": {"detections": not_list}}],
            },
            {
                "type": "object",
                "properties": {"detections": crops, **moved, **common},
                "required": ["detections"],
                "allOf": [one_picture],
            },
            {
                "type": "object",
                "properties": {"views": _views_schema(movement, together), **common},
                "required": ["views"],
                "allOf": [{"properties": dict.fromkeys(("crops", "detections"), _NULL)}],
            },
            crops,
        ],
    }


def _crops_schema() -> dict[str, Any]:
    crop = CropModel.model_json_schema(by_alias=True)
    float32 = np.finfo(np.float32)
    largest, least = float(float32.max), float(float32.smallest_subnormal)
    numbers = {
        "type": "array",
        "items": {"type": "number", "minimum": -largest, "maximum": largest},
        "minItems": 1,
        "maxItems": MAX_DIMENSION,
        "contains": {"anyOf": [{"minimum": least}, {"maximum": -least}]},  # not only zeros
    }
    crop["properties"]["embedding"]["anyOf"] = [_EMBEDDING_TEXT, numbers, _NULL]
    crop |= {
        "title": "Crop",
        "description": "An object in a picture; it needs an embedding or a class.",
    }
    return {"type": "array", "items": crop, "maxItems": MAX_CROPS}


def _views_schema(movement: dict[str, Any], together: dict[str, Any]) -> dict[str, Any]:
    view = {
        "title": "View",
        "type": "object",
        "description": "The movement since the view before, and the crops of this view.",
        "properties": {**movement, "crops": _crops_schema()},
        "required": ["crops", *movement],
    }
    first = {
        **view,
        "title": "First view",
        "description": "The movement is that since the previous question, only read with a"
        " session.",
        "required": ["crops"],
        "dependentRequired": together,
    }
    searchable = {"required": ["crops"], "properties": {"crops": {"contains": _SEARCHABLE}}}
    return {
        "type": "array",
        "prefixItems": [first],
        "items": view,
        "minItems": 1,
        "maxItems": MAX_VIEWS,
        "contains": searchable,
    }
