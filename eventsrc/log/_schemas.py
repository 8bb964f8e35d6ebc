"""Which JSON schema stands behind a key, generated from the models that check the payloads."""

import functools
import json

from pydantic import BaseModel

from eventsrc.envelope import Envelope
from eventsrc.system_events import LOSS_KEY, REJECTED_KEY, Loss, RejectedPayload, is_system_key

_SYSTEM_MODELS: dict[str, type[BaseModel]] = {REJECTED_KEY: RejectedPayload, LOSS_KEY: Loss}


def schema_of(key: str) -> tuple[str, bytes]:
    """Name and JSON schema text of what ``key`` carries."""
    if not is_system_key(key):
        return "mapfold.Envelope", _json_schema(Envelope)
    model = _SYSTEM_MODELS.get(key)
    if model is None:
        return "mapfold.System", b'{"type": "object"}'
    return f"mapfold.{model.__name__}", _json_schema(model)


@functools.cache
def _json_schema(model: type[BaseModel]) -> bytes:
    return json.dumps(model.model_json_schema(by_alias=True), sort_keys=True).encode()
