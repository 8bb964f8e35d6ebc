"""Channels of a segment, and the schemas of what is on them.

Foxglove makes the fields of a message from its channel's schema, and reads no ``$ref``, ``anyOf``
or ``prefixItems``: it then shows nothing of the channel. So our schemas are one tree: a reference
is replaced by the schema it names, an optional field has the type of its value, a tuple is an array
of its first item's type, and of several types a field has the first. Such a schema describes
payloads; it does not validate them: a field may also be null.
"""

import functools
import json
import re
from typing import Any, Final

from pydantic import BaseModel, TypeAdapter

from eventsrc.envelope import system_events
from eventsrc.envelope.commands import COMMAND
from eventsrc.envelope.dropped_classes import DropClasses
from eventsrc.envelope.model import ENVELOPE_VERSION
from eventsrc.envelope.occupancy_map import OccupancyMapEvent
from eventsrc.envelope.readers import EnvelopeModel

from .event import MessageFormat
from .mcap_records import Channel, Schema

ENVELOPE_VERSION_KEY = "mapfold.envelope_version"
UNREADABLE_VERSION = 0
"""The version of a channel whose metadata has no number for it: forged, or of another program. Its
events are read and not folded."""
_VERSION = re.compile(r"[0-9]{1,9}")

_SYSTEM_MODELS: dict[str, type[BaseModel]] = {
    system_events.REJECTED_KEY: system_events.RejectedPayload,
    system_events.LOSS_KEY: system_events.Loss,
    system_events.MAP_KEY: OccupancyMapEvent,
    system_events.EMBEDDINGS_KEY: system_events.Embeddings,
    system_events.DROP_KEY: DropClasses,
}


def schema_of(key: str) -> tuple[str, bytes]:
    """Name and JSON schema text of the payloads under ``key``."""
    if not system_events.is_system_key(key):
        return "mapfold.Envelope", _json_schema(EnvelopeModel)
    if key == system_events.COMMAND_KEY:
        return "mapfold.Command", _json_schema(COMMAND)
    model = _SYSTEM_MODELS.get(key)
    if model is None:
        return "mapfold.System", b'{"properties": {}, "type": "object"}'
    return f"mapfold.{model.__name__}", _json_schema(model)


@functools.cache
def _json_schema(model: type[BaseModel] | TypeAdapter[Any]) -> bytes:
    return json.dumps(flat_schema(model), sort_keys=True).encode()


def key_channel(channel_id: int, schema_id: int, key: str, version: int) -> Channel:
    """The channel of ``key`` for envelopes of ``version``."""
    return Channel(
        id=channel_id,
        topic=key,
        message_encoding="json",
        schema_id=schema_id,
        metadata={ENVELOPE_VERSION_KEY: str(version)},
    )


def envelope_version(channel: Channel) -> int:
    """The version of the envelopes on a channel; the current one if it has none."""
    version = channel.metadata.get(ENVELOPE_VERSION_KEY)
    if version is None:
        return ENVELOPE_VERSION
    return int(version) if _VERSION.fullmatch(version) else UNREADABLE_VERSION


VERBATIM_KEY = "mapfold.verbatim"
"""In the metadata of the channel of verbatim messages, and of no other."""
NO_SCHEMA = 0
"""The schema id of a channel without a schema, by the specification of MCAP."""


def verbatim_channel(channel_id: int, schema_id: int, topic: str, encoding: str) -> Channel:
    """The channel of verbatim messages of one topic and format."""
    return Channel(
        id=channel_id,
        topic=topic,
        message_encoding=encoding,
        schema_id=schema_id,
        metadata={VERBATIM_KEY: "1"},
    )


def is_verbatim(channel: Channel) -> bool:
    """Whether the messages of a channel are verbatim messages."""
    return VERBATIM_KEY in channel.metadata


def message_format(channel: Channel, schema: Schema | None) -> MessageFormat:
    """The format of the messages on a verbatim channel; without its schema if that is lost."""
    if schema is None:
        return MessageFormat(channel.message_encoding)
    return MessageFormat(channel.message_encoding, schema.name, schema.encoding, schema.data)


def carries_envelopes(channel: Channel) -> bool:
    """Whether the messages of a channel are envelopes, of any version."""
    return not (system_events.is_system_key(channel.topic) or is_verbatim(channel))


_Schema = dict[str, Any]
_SCALARS: Final = ("boolean", "integer", "number", "string")


def flat_schema(model: type[BaseModel] | TypeAdapter[Any]) -> _Schema:
    """The flat schema of a model; of a union of models, with the fields that all of them have.

    Raises TypeError for a field that viewers have no type for, such as an array of arrays.
    """
    if isinstance(model, TypeAdapter):
        schema = model.json_schema(by_alias=True)
    else:
        schema = model.model_json_schema(by_alias=True)
    return _flat_object(schema, schema.get("$defs", {}))


def _flat_object(schema: _Schema, defs: _Schema) -> _Schema:
    if "oneOf" in schema:
        return _common_fields([_resolved(each, defs) for each in schema["oneOf"]], defs)
    kept = {name: value for name, value in schema.items() if name != "$defs"}
    fields = schema.get("properties", {})
    return {**kept, "properties": {name: _flat(name, each, defs) for name, each in fields.items()}}


def _common_fields(models: list[_Schema], defs: _Schema) -> _Schema:
    """An object with the fields of the first model that every model has."""
    first, *others = [model["properties"] for model in models]
    names = [name for name in first if all(name in other for other in others)]
    fields = {name: _flat(name, first[name], defs) for name in names}
    for name, field in fields.items():
        if any(other[name] != first[name] for other in others):  # the kind, constant in each model
            fields[name] = {"type": field["type"]}
    return {"type": "object", "properties": fields, "additionalProperties": {}}


def _flat(name: str, schema: _Schema, defs: _Schema) -> _Schema:
    schema = _resolved(schema, defs)
    kind = schema.get("type")
    if kind == "object":
        return _flat_object(schema, defs)
    if kind == "array":
        return _flat_array(name, schema, defs)
    if kind not in _SCALARS:
        raise TypeError(f"field {name!r} has a type that viewers do not read: {schema}")
    return schema


def _flat_array(name: str, schema: _Schema, defs: _Schema) -> _Schema:
    kept = {key: value for key, value in schema.items() if key != "prefixItems"}
    item = schema.get("items") or schema["prefixItems"][0]
    items = _flat(name, item, defs)
    if items["type"] == "array":
        raise TypeError(f"field {name!r} is an array of arrays; viewers read none: {schema}")
    return {**kept, "items": items}


def _resolved(schema: _Schema, defs: _Schema) -> _Schema:
    """``schema`` with its reference replaced, and the first type of several that is not null."""
    rest = dict(schema)
    if "$ref" in rest:
        return _resolved({**defs[rest.pop("$ref").rsplit("/", 1)[-1]], **rest}, defs)
    if "anyOf" in rest:
        types = [each for each in rest.pop("anyOf") if each.get("type") != "null"]
        if rest.get("default", 0) is None:
            del rest["default"]
        return _resolved({**types[0], **rest}, defs)
    return rest
