"""The quick reader of envelopes accepts nothing that the models refuse, and reads the same."""

import json
import re
from typing import Any
from unittest.mock import patch

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from eventsrc.envelope.ingest import (
    Accepted,
    CheckedEnvelope,
    Rejected,
    Vector,
    check_all,
    ingest,
    ingest_all,
)
from eventsrc.envelope.model import Detection, Envelope, StatedCamera
from eventsrc.envelope.readers import (
    DetectionModel,
    EnvelopeCamera,
    EnvelopeModel,
    read_checked,
    read_plain,
)
from projections.fold.folded_ids import content_digest
from tests.support.envelopes import detection, envelope, fields_of, payload
from tests.support.thorough import examples

EDGE_TEXTS = r"""
0 -0 0.0 -0.0 1 1.0 1e0 1e2 01 1. .5 +1 0x1 1_0 1E+2 1e-400 5e-324 1e308 1e309 1e400 -1e400 1e23
0.001 0.0009999999999999999 1000.0 1000 1000.0000000000001 170 170.00000000000003 1e6
1000000.0000000001 7 7.0 7.000000000000001 -7.000000000000001 1e7 10000000.000000002 -1e7 9e9
9000000000.000002 9000000001 16000 16001 9223372036854775807 9223372036854775808
-9223372036854775808 -9223372036854775809 18446744073709551615 18446744073709551616
123456789012345678901234567890 1774357200.123456789 0.1234567891234567 1e-7 123456789.123456784
NaN Infinity -Infinity nan null true false "" "a" "1" "\u0000" "\u0009" "\n" "a\n" "\u007f" "\u0080"
"\u0085" "\u009f" "\u00a0" "\u200b" "\u2028" "\ud800" "\udc00\ud800" "\ud83e\ude91" "🪑" "é" "\/"
"\x" "\u00g0"
[] {} [1] [1,2] [1,2,3] [1,2,3,4] [1,2,3,4,5] [1,2,3,"4"] [1,2,3,null] [1,2,3,1e400] [1,2,3,4,]
{"a":NaN} [0.01,0,0,0,0.01,0,0,0,0.0004] [0.01,0.02,0,0.02,0.01,0,0,0,0.0004] [1,0,0,0,1,0,0,0,-1]
{"hfov_deg":69.4,"width_px":640,"height_px":400} {"hfov_deg":0.5,"width_px":640,"height_px":400}
{"hfov_deg":69.4,"width_px":640,"height_px":400,"yaw_rad":null} {"hfov_deg":69.4,"width_px":640}
"AACAPwAAAAA=" "AACAPwAAAAA" "AAAAAAAAAAA=" "AADAfwAAgD8=" "AACAPwAAgD8="
"""
EDGES = [*EDGE_TEXTS.split(), '"a\x7fb"', '"a\x85b"', '"a\xa0b"', '"a b"', '"AACA PwAAgD8="']
"""Values as JSON texts, at and beyond every bound, and some that are no JSON."""
LONG = [json.dumps("x" * length) for length in (255, 256, 257)] + [json.dumps("é" * 256)]
VALUES = st.sampled_from([*EDGES, *LONG]) | st.floats().map(json.dumps) | st.text().map(json.dumps)
PLAIN = {
    "run_id": '"run-a"',
    "keyframe_id": "7",
    "timestamp": "1774357207.25",
    "map_x": "1.5",
    "map_y": "-2",
    "map_yaw": "0.5",
}
OF_ENVELOPE = [*PLAIN, "camera", "floor", "map_z", "pose_covariance", "detections", "note"]
OF_DETECTION = [*Detection.__struct_encode_fields__, "class_name", "x"]
Members = list[tuple[str, str]]


def written(members: Members) -> str:
    """A JSON object, with names that may stand twice."""
    return "{" + ",".join(f'"{name}":{value}' for name, value in members) + "}"


def detections_with(more: Members) -> st.SearchStrategy[str]:
    """Up to three detections with these members and perhaps another."""
    known = [("class", '"cup"'), ("confidence", "0.5"), ("bbox", "[0,0,1,1]"), *more]
    odd = st.lists(st.tuples(st.sampled_from(OF_DETECTION), VALUES), max_size=1)
    found = st.lists(odd.map(lambda members: written([*known, *members])), max_size=3)
    return found.map(lambda each: f"[{','.join(each)}]")


ODD = st.lists(st.tuples(st.sampled_from(OF_ENVELOPE), VALUES), max_size=2)


def payloads_of(detections: st.SearchStrategy[str]) -> st.SearchStrategy[bytes]:
    """Envelopes with these detections and up to two odd members."""
    return st.builds(
        lambda odd, found, left_out, first: written(
            ([*odd] if first else [])
            + [m for m in PLAIN.items() if m[0] != left_out]
            + [("detections", found)]
            + ([] if first else [*odd])
        ).encode(errors="surrogatepass"),
        ODD,
        detections,
        st.sampled_from([*PLAIN] + 20 * [""]),
        st.booleans(),
    )


PAYLOADS = payloads_of(detections_with([]))
EMBEDDED_PAYLOADS = payloads_of(
    detections_with([("embedding", '"AACAPwAAAAA="'), ("embedding_dim", "2")])
)
CAMERA = {"hfov_deg": 69.4, "width_px": 640, "height_px": 400}
NINE = [0.01, 0, 0, 0, 0.01, 0, 0, 0, 0.0004]


def by_models(raw: bytes) -> Accepted | Rejected:
    """What the models say: pydantic decides."""
    with patch("eventsrc.envelope.ingest.read_plain", return_value=None):
        return ingest(raw)


def bytes_of(vector: Vector | None) -> bytes | None:
    return None if vector is None else vector.tobytes()


def checked(raw: bytes) -> CheckedEnvelope | Rejected:
    """The same, of callers that keep the bytes."""
    result = by_models(raw)
    return result if isinstance(result, Rejected) else CheckedEnvelope.of(result.envelope)


@settings(max_examples=examples(300), suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(PAYLOADS, min_size=1, max_size=3))
@example([b'{"run_id":"a","run_id":"b","keyframe_id":1,"timestamp":0,"detections":[]}'])
@example([b'\xef\xbb\xbf{"run_id":"a","keyframe_id":1,"timestamp":0,"detections":[]}'])
@example([b'{"run_id":"a\xff","keyframe_id":1,"timestamp":0,"detections":[]}'])
@example([b'{"run_id":"a\xed\xa0\x80","keyframe_id":1,"timestamp":0,"detections":[]}'])
@example([b' {"run_id":"a","keyframe_id":1,"timestamp":0,"detections":[]}\n\t ', b"", b"{}", b"[]"])
@example([b'{"run_id":"a","keyframe_id":1,"timestamp":0,"detections":[]}x'])
@example([b'{"run_id":"a","keyframe_id":1,"timestamp":0,"detections":[]}\x00'])
@example([b'{"run_\\u0069d":"a","keyframe_id":1,"timestamp":0,"detections":[]}'])
def test_checked_together_each_is_answered_as_pydantic_does(payloads: list[bytes]) -> None:
    assert check_all(payloads) == [checked(raw) for raw in payloads]


@settings(max_examples=examples(300), suppress_health_check=[HealthCheck.too_slow])
@given(PAYLOADS)
def test_what_is_read_quickly_is_what_the_models_read(raw: bytes) -> None:
    plain = read_plain(raw)
    if plain is None:
        return
    whole = read_checked(raw)
    assert plain == whole
    assert fields_of(plain) == fields_of(whole)


@settings(max_examples=examples(300), suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(EMBEDDED_PAYLOADS, min_size=1, max_size=3))
@example([payload(envelope(0, detections=[detection("a", [1.0, 2.0], det_id="x")], floor=2))])
@example([payload(envelope(1, detections=[detection("a", [1.0, 2.0])], pose_covariance=NINE))])
@example([payload(envelope(2, detections=[detection("a", [1.0, 2.0])], camera=CAMERA))])
def test_read_together_they_have_the_fields_and_vectors_of_the_models(raws: list[bytes]) -> None:
    for quick, whole in zip(ingest_all(raws), map(by_models, raws), strict=True):
        if isinstance(whole, Rejected):
            assert quick == whole
            continue
        assert isinstance(quick, Accepted)
        assert fields_of(quick.envelope) == fields_of(whole.envelope)
        assert quick.det_ids == whole.det_ids
        assert list(map(bytes_of, quick.vectors)) == list(map(bytes_of, whole.vectors))
        assert content_digest(quick) == content_digest(whole)


@given(st.floats(0.0, 9e9))
def test_times_are_read_to_the_last_bit(timestamp: float) -> None:
    raw = payload(envelope(timestamp=timestamp))
    assert read_plain(raw) is not None
    assert check_all([raw]) == [checked(raw)]


def test_usual_envelopes_are_read_quickly() -> None:
    evidence: dict[str, Any] = {"depth_m": 2.4, "depth_sigma_m": 0.1, "position": [2.2, 3.2]}
    camera = {"hfov_deg": 69.4, "width_px": 640, "height_px": 400}
    covariance = [0.01, 0, 0, 0, 0.01, 0, 0, 0, 0.0004]
    for document in (
        envelope(),
        envelope(x=None),
        envelope(run_id="r🪑", detections=[detection("tasse à café", [1.0, 2.0]), detection()]),
        envelope(camera=camera, floor=1, map_z=2.9, pose_covariance=covariance),
        envelope(floor="attic", detections=[detection("cup", [1.0, 2.0], **evidence)]),
        envelope(detections=[detection(det_id="a"), detection(det_id="b")]),
    ):
        assert read_plain(payload(document)) is not None, document
    for document in (
        envelope(detections=[detection(det_id="a"), detection(det_id="a")]),
        envelope(detections=[detection(det_id="run-a_kf1_d1"), detection()]),
    ):
        assert read_plain(payload(document)) is None, document


def test_only_what_must_be_looked_at_is_asked_of_pydantic(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not what was checked together with it: vectors of two models, and bad ones of another."""
    three, two = [1.0, 2.0, 3.0], [0.5, 0.25]
    sound = [
        payload(envelope(n, detections=[detection("cup", vector) for vector in vectors]))
        for n, vectors in enumerate(([three, three], [two], [two, three], [None, two], []))
    ]
    bad = payload(envelope(9, detections=[detection("cup", [0.0, 0.0, 0.0])]))
    asked: list[bytes] = []

    def asking(raw: bytes) -> Any:
        asked.append(raw)
        return read_checked(raw)

    monkeypatch.setattr("eventsrc.envelope.ingest.read_checked", asking)
    expected = [checked(raw) for raw in [*sound, bad, *sound]]
    asked.clear()
    assert check_all(sound) == expected[: len(sound)]
    assert asked == []
    assert check_all([*sound, bad, *sound]) == expected
    assert asked == [bad]


def test_the_fields_are_those_of_the_models() -> None:
    for model, plain in (
        (EnvelopeModel, Envelope),
        (DetectionModel, Detection),
        (EnvelopeCamera, StatedCamera),
    ):
        known = {field.alias or name for name, field in model.model_fields.items()}
        assert known == {*plain.__struct_encode_fields__}


def test_no_control_character_is_printable() -> None:
    control = re.compile(r"[\x00-\x1f\x7f-\x9f]")
    assert not any(control.search(chr(i)) for i in range(0x110000) if chr(i).isprintable())
