"""Channels and the JSON schemas behind them, generated from the models that check the payloads."""

import functools
import json
import re

from pydantic import BaseModel

from eventsrc.envelope import ENVELOPE_VERSION, Envelope
from eventsrc.system_events import LOSS_KEY, REJECTED_KEY, Loss, RejectedPayload, is_system_key

from ._mcap import Channel

ENVELOPE_VERSION_KEY = "mapfold.envelope_version"
UNREADABLE_VERSION = 0
"""Of a channel that says something else than a number: another program's, or forged. Its events are
read, and not folded."""
_A_VERSION = re.compile(r"[0-9]{1,9}")

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


def key_channel(channel_id: int, schema_id: int, key: str, version: int) -> Channel:
    """The channel of a key whose envelopes are of ``version``."""
    return Channel(
        id=channel_id,
        topic=key,
        message_encoding="json",
        schema_id=schema_id,
        metadata={ENVELOPE_VERSION_KEY: str(version)},
    )


def envelope_version(channel: Channel) -> int:
    """The version of the envelopes on a channel; the current one where none is said."""
    said = channel.metadata.get(ENVELOPE_VERSION_KEY)
    if said is None:
        return ENVELOPE_VERSION
    return int(said) if _A_VERSION.fullmatch(said) else UNREADABLE_VERSION
