"""What viewers refuse of a JSON schema, as Foxglove Studio's ``parseJsonSchema`` does."""

from typing import Any

SCALARS = {"boolean": "bool", "integer": "float64", "number": "float64", "string": "string"}


class NotRead(Exception):
    """A schema that viewers do not read."""


def parse_json_schema(schema: dict[str, Any], name: str) -> dict[str, dict[str, str]]:
    """Field names and types of ``name`` and of the objects in it. Raises NotRead.

    It looks at ``type``, ``properties``, ``items`` and ``contentEncoding``, and at nothing else.
    """
    found: dict[str, dict[str, str]] = {}
    if schema.get("type") != "object":
        raise NotRead(f"{name} is of type {schema.get('type')}")
    if "properties" not in schema:
        raise NotRead(f"{name} has no properties")
    fields = found[name] = {}
    for field, each in schema["properties"].items():
        at, kind, array = f"{name}.{field}", each.get("type"), ""
        if kind == "array":
            if not isinstance(each.get("items"), dict):
                raise NotRead(f"{at} is an array of unknown items")
            each, array = each["items"], "[]"
            kind = each.get("type")
        if kind == "object":
            found.update(parse_json_schema(each, at))
        elif kind not in SCALARS:
            raise NotRead(f"{at} is of type {kind}")
        elif "contentEncoding" in each:
            raise NotRead(f"{at} is encoded")
        fields[field] = (at if kind == "object" else SCALARS[kind]) + array
    return found
