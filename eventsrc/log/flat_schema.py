"""JSON schemas that viewers can read: one tree without references or alternatives.

Foxglove makes the fields of a message from its channel's schema, and reads no ``$ref``, ``anyOf``
or ``prefixItems``: it then shows nothing of the channel. So a reference is replaced by the schema
it names, an optional field has the type of its value, a tuple is an array of its first item's type,
and of several types a field has the first. Such a schema describes payloads; it does not validate
them: a field may also be null.
"""

from typing import Any, Final

from pydantic import BaseModel, TypeAdapter

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
