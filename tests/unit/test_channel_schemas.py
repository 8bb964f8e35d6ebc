"""The schemas in a log, as viewers read them."""

import json
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from pydantic import create_model

from eventsrc.envelope import system_events
from eventsrc.envelope.commands import KINDS, KeepApart, encode_command
from eventsrc.envelope.readers import EnvelopeModel
from eventsrc.log import LogWriter
from eventsrc.log.channels import flat_schema, schema_of
from tests.support.envelopes import detection, envelope, payload

SYSTEM_KEYS = sorted(value for name, value in vars(system_events).items() if name.endswith("_KEY"))
KEYS = ["tb/detections", "robots/7/seen", *SYSTEM_KEYS, "mapfold/of-a-later-version"]
SAMPLE = Path(__file__).resolve().parents[2] / "logs" / "sample"
SCALARS = {"boolean": "bool", "integer": "float64", "number": "float64", "string": "string"}


class NotRead(Exception):
    """A schema that viewers do not read."""


def parse_json_schema(schema: dict[str, Any], name: str) -> dict[str, dict[str, str]]:
    """Field names and types of ``name`` and of the objects in it, as Foxglove Studio reads them
    by the function of this name. Raises NotRead.

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


def parsed(key: str) -> dict[str, dict[str, str]]:
    name, text = schema_of(key)
    return parse_json_schema(json.loads(text), name)


def test_the_keys_of_our_own_are_known_here() -> None:
    assert {"mapfold/command", "mapfold/loss", "mapfold/map", "mapfold/rejected"} <= set(
        SYSTEM_KEYS
    )


@pytest.mark.parametrize("key", KEYS)
def test_viewers_read_the_schema_of_every_key(key: str) -> None:
    text = schema_of(key)[1].decode()
    assert parsed(key)
    assert not [word for word in ("$ref", "$defs", "anyOf", "oneOf", "prefixItems") if word in text]


def test_the_schema_that_pydantic_makes_is_refused() -> None:
    with pytest.raises(NotRead, match=r"map_x|floor|camera|detections"):
        parse_json_schema(EnvelopeModel.model_json_schema(by_alias=True), "Envelope")


def test_an_envelope_has_every_field_with_its_type() -> None:
    types = parsed("tb/detections")
    fields = types["mapfold.Envelope"]
    assert set(fields) == {f.alias or n for n, f in EnvelopeModel.model_fields.items()}
    assert fields["detections"] == "mapfold.Envelope.detections[]"
    assert fields["camera"] == "mapfold.Envelope.camera"
    assert (fields["map_x"], fields["keyframe_id"], fields["floor"]) == (
        "float64",
        "float64",
        "string",
    )
    seen = types["mapfold.Envelope.detections"]
    assert {"det_id", "class", "confidence", "bbox", "embedding", "position"} <= set(seen)
    assert (seen["bbox"], seen["position"], seen["class"]) == ("float64[]", "float64[]", "string")
    assert types["mapfold.Envelope.camera"]["yaw_rad"] == "float64"


def test_a_command_has_the_fields_that_every_kind_has() -> None:
    fields = parsed("mapfold/command")["mapfold.Command"]
    assert fields == dict.fromkeys(["command_id", "issued_by", "reason", "kind"], "string")
    assert "const" not in schema_of("mapfold/command")[1].decode()
    assert len(KINDS) > 1


@pytest.mark.parametrize("field", [list[list[float]], None])
def test_a_model_with_a_field_that_viewers_cannot_read_is_refused(field: Any) -> None:
    with pytest.raises(TypeError, match="'odd'"):
        flat_schema(create_model("Odd", odd=(field, ...)))


def segment_schemas(file: Path) -> dict[str, dict[str, Any]]:
    with file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return {s.name: json.loads(s.data) for s in summary.schemas.values()}


def test_the_schemas_of_a_segment_are_flat(tmp_path: Path) -> None:
    command = KeepApart.model_validate(
        {
            "command_id": "c",
            "issued_by": "me",
            "places": ({"run_id": "a", "keyframe_id": 1}, {"run_id": "a", "keyframe_id": 2}),
        }
    )
    with LogWriter(tmp_path / "log") as writer:
        document = envelope(1, run_id="new", detections=[detection("cup", [1.0, 0.0])])
        writer.append("tb/detections", payload(document))
        writer.append("mapfold/command", encode_command(command))
    (segment,) = (tmp_path / "log").glob("*.mcap")
    schemas = segment_schemas(segment)
    assert sorted(schemas) == ["mapfold.Command", "mapfold.Envelope"]
    assert all(parse_json_schema(schema, name) for name, schema in schemas.items())
    (sample,) = SAMPLE.glob("*.mcap")
    assert parse_json_schema(segment_schemas(sample)["mapfold.Envelope"], "sample")
