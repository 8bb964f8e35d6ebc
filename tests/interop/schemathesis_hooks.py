"""What `schemathesis` cannot read from the description: what fits the map that is served.

Only cases that should be accepted are changed. Those that should be refused are sent as they are.
"""

import base64
import itertools
import os
import struct
from typing import Any

import schemathesis

CLASSES = ("toilet", "mirror", "sink")
DIMENSION = 512
MODEL = os.environ["MAPFOLD_EMBEDDING_MODEL"]
MOST_CROPS = 32
OBJECT = "oven"
"""A class that one Object of the map has; its place is called bath."""


@schemathesis.hook
def before_call(
    context: schemathesis.HookContext, case: schemathesis.Case, kwargs: dict[str, Any]
) -> None:
    """Fit a case that should be accepted to the map."""
    if case.meta is None or not case.meta.generation.mode.is_positive:
        return
    if case.operation.path == "/relocalize":
        _fit(case.body)
    if case.operation.path in ("/objects/{name}", "/objects/{name}/goal"):
        case.path_parameters["name"] = OBJECT
    if case.operation.path == "/crops/{name}":
        case.path_parameters["name"] = "shown"
    if case.operation.path == "/path":
        case.query |= {"from": "bath", "to": OBJECT}
    if case.operation.path == "/changes":
        case.query |= {"since": "0", "until": "end"}


def _fit(question: Any) -> None:
    pictures = [question]
    if isinstance(question, dict):
        pictures = [question.get("crops"), question.get("detections")]
        pictures += [view["crops"] for view in question.get("views") or ()]
    left = MOST_CROPS  # it counts those of all pictures
    for crops in pictures:
        if isinstance(crops, list):
            del crops[max(left, 1) :]
            left -= len(crops)
            for crop in crops:
                _fit_crop(crop)


def _fit_crop(crop: dict[str, Any]) -> None:
    if crop.get("class") is not None:
        crop["class"] = CLASSES[len(crop["class"]) % len(CLASSES)]
    embedding = crop.get("embedding")
    if isinstance(embedding, str):
        crop["embedding"] = base64.b64encode(struct.pack("<f", 1.0) * DIMENSION).decode()
    elif embedding is not None:
        numbers = [number for number in embedding if number]
        crop["embedding"] = list(itertools.islice(itertools.cycle(numbers), DIMENSION))
    for key, value in (("embedding_dim", DIMENSION), ("embedding_model", MODEL)):
        if crop.get(key) is not None:
            crop[key] = value
