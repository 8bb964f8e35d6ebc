"""Every rejection of an invalid envelope, with a reason that names the field."""

import json
from typing import Any

import numpy as np
import pytest

from eventsrc.envelope.ingest import Accepted, Rejected, ingest
from eventsrc.envelope.model import Envelope, has_evidence
from tests.support.envelopes import detection, embedding, envelope, payload

VECTOR = [0.6, 0.8, 0.0, 0.0]


def refusal(document: Any, **options: Any) -> str:
    result = ingest(document if isinstance(document, bytes) else payload(document), **options)
    assert isinstance(result, Rejected)
    return result.reason


def accepted(document: Any) -> Accepted:
    result = ingest(payload(document))
    assert isinstance(result, Accepted), result
    return result


def without(document: dict[str, Any], field: str) -> dict[str, Any]:
    return {k: v for k, v in document.items() if k != field}


def test_a_valid_envelope_is_accepted_unchanged_with_its_vectors() -> None:
    sent = envelope(
        42, 2.14, 0.83, detections=[detection("cup", VECTOR, det_id="d"), detection("chair")]
    )
    read = accepted(sent)
    assert read.envelope.run_id == "run-a"
    assert read.envelope.keyframe_id == 42
    assert (read.envelope.map_x, read.envelope.map_y, read.envelope.map_yaw) == (2.14, 0.83, 0.0)
    assert read.det_ids == ("d", "run-a_kf42_d1")
    assert read.vectors[0] is not None
    assert read.vectors[0].tolist() == np.asarray(VECTOR, dtype=np.float32).tolist()
    assert read.vectors[1] is None


def test_unknown_fields_are_accepted() -> None:
    accepted(envelope(battery=0.4, detections=[detection(track=7)]))


@pytest.mark.parametrize("odd", [float("nan"), float("-inf"), [0.1, {"deep": [float("inf")]}]])
def test_nan_and_infinity_in_unknown_fields_are_rejected(odd: Any) -> None:
    """Python would read it; the log is read by others as well, who would not."""
    assert refusal(envelope(covariance=odd)).startswith("covariance: holds NaN or infinity (got ")
    seen = [detection(), detection(depth=odd)]
    assert refusal(envelope(detections=seen)).startswith(
        "detections.1.depth: holds NaN or infinity"
    )


def test_an_unknown_field_named_like_one_of_ours_changes_nothing() -> None:
    odd = dict.fromkeys(("stamp_ns", "model_config", "model_dump", "__class__", ""), 7)
    read = accepted(envelope(**odd))
    assert read.envelope.stamp_ns == 1_774_357_201_000_000_000
    assert isinstance(read.envelope, Envelope)


def test_an_empty_frame_names_none() -> None:
    """As an unset frame_id of ROS; logs had it before frames were read."""
    assert accepted(envelope(frame="")).envelope.frame is None
    assert accepted(envelope(frame=7)).envelope.frame is None
    assert accepted(envelope(frame="odom")).envelope.frame == "odom"


def test_an_envelope_without_a_pose_is_accepted() -> None:
    assert accepted(envelope(x=None)).envelope.map_x is None
    assert accepted(envelope(map_x=None, map_y=None, map_yaw=None)).envelope.map_x is None


@pytest.mark.parametrize(
    "name", ["baker's rack", "x'}) DETACH DELETE r //", "$$; drop table", "🪑é"]
)
def test_names_may_hold_any_printable_character(name: str) -> None:
    read = accepted(envelope(run_id=name, detections=[detection(name)]))
    assert read.envelope.run_id == name
    assert read.envelope.detections[0].class_name == name


@pytest.mark.parametrize(
    ("stamp", "stamp_ns"),
    [
        (0.0, 0),
        (1774357234.567, 1_774_357_234_567_000_000),
        (1560000002.614, 1_560_000_002_614_000_000),
        (1e-9, 1),
    ],
)
def test_stamp_ns_is_exact_to_the_decimal_that_was_sent(stamp: float, stamp_ns: int) -> None:
    assert accepted(envelope(timestamp=stamp)).envelope.stamp_ns == stamp_ns


@pytest.mark.parametrize(
    ("raw", "says"),
    [
        (b"", "not JSON"),
        (b"\xff\xfe", "not JSON"),
        (b"{", "not JSON"),
        (b"[" * 100_000, "not JSON"),
        (b"[1]", "not a JSON object but list"),
        (b'"x"', "not a JSON object but str"),
        (b"null", "not a JSON object but NoneType"),
    ],
)
def test_what_is_no_json_object_is_refused(raw: bytes, says: str) -> None:
    assert refusal(raw).startswith(says)


@pytest.mark.parametrize("field", ["run_id", "keyframe_id", "timestamp", "detections"])
def test_a_missing_field_is_named(field: str) -> None:
    assert refusal(without(envelope(), field)) == f"{field}: required field is missing"


@pytest.mark.parametrize("field", ["class", "confidence", "bbox"])
def test_a_missing_field_of_a_detection_is_named_with_its_place(field: str) -> None:
    broken = envelope(detections=[detection(), without(detection(), field)])
    assert refusal(broken) == f"detections.1.{field}: required field is missing"


@pytest.mark.parametrize(
    "fields",
    [
        {"run_id": 7},
        {"run_id": None},
        {"keyframe_id": "1"},
        {"keyframe_id": 1.5},
        {"keyframe_id": True},
        {"keyframe_id": 2**63},
        {"timestamp": "now"},
        {"timestamp": -1.0},
        {"timestamp": 1e300},
        {"map_x": "2"},
        {"map_x": 1e8},
        {"map_y": None},
        {"map_yaw": None},
        {"detections": None},
        {"detections": {}},
        {"detections": [None]},
        {"detections": [detection(bbox=[1.0, 2.0, 3.0])]},
        {"detections": [detection(bbox=[1.0, 2.0, 3.0, "4"])]},
        {"detections": [detection(confidence="high")]},
        {"detections": [detection(**{"class": 3})]},
        {"detections": [detection(det_id=3)]},
        {"detections": [detection(embedding=[0.1, 0.2])]},
    ],
    ids=lambda fields: json.dumps(fields)[:60],
)
def test_a_wrong_type_or_range_is_refused(fields: dict[str, Any]) -> None:
    reason = refusal({**envelope(), **fields})
    assert next(iter(fields)) in reason


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999"])
@pytest.mark.parametrize("field", ["timestamp", "map_x", "map_yaw"])
def test_numbers_must_be_finite(field: str, number: str) -> None:
    raw = payload(envelope(**{field: 123456789.25})).replace(b"123456789.25", number.encode())
    assert refusal(raw).startswith(f"{field}: ")


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_a_byte_order_mark_is_named(encoding: str) -> None:
    reason = refusal(json.dumps(envelope()).encode(encoding))
    assert reason == "not JSON: begins with a byte order mark; send UTF-8 without one"


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"embedding": "***"}, "not base64: Only base64 data is allowed"),
        ({"embedding": "AACAPw==="}, "not base64: Excess"),
        ({"embedding": "AACA="}, "not base64: "),
        ({"embedding_dim": 5}, "16 bytes do not match embedding_dim 5, which takes 20"),
        ({"embedding_dim": None}, "required beside an embedding"),
        ({"embedding_dim": 0}, "embedding_dim"),
        (embedding([0.0, -0.0, 0.0, 0.0]), "zero vector"),
        (embedding([float("nan"), 1.0, 0.0, 0.0]), "NaN or infinity"),
        (embedding([float("inf"), 1.0, 0.0, 0.0]), "NaN or infinity"),
    ],
)
def test_a_bad_vector_is_refused(fields: dict[str, Any], says: str) -> None:
    reason = refusal(envelope(detections=[detection("cup", VECTOR, **fields)]))
    assert "detections.0.embedding" in reason
    assert says in reason


@pytest.mark.parametrize("field", ["run_id", "det_id", "class", "embedding_model"])
@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "is empty"),
        ("x" * 257, "is 257 characters long, more than 256"),
        ("a\x00b", "has the control character U+0000 at index 1"),
        ("tab\t", "has the control character U+0009 at index 3"),
        ("\x85", "has the control character U+0085 at index 0"),
    ],
    ids=["empty", "long", "nul", "tab", "c1"],
)
def test_empty_long_or_control_characters_in_ids_are_rejected(
    field: str, text: str, says: str
) -> None:
    broken = (
        envelope(run_id=text)
        if field == "run_id"
        else envelope(detections=[detection("cup", VECTOR, **{field: text})])
    )
    assert says in refusal(broken)


def test_an_id_of_256_characters_is_accepted() -> None:
    accepted(envelope(run_id="x" * 256))


def test_a_det_id_twice_in_one_envelope_is_refused() -> None:
    twice = [detection(det_id="d"), detection(), detection(det_id="d")]
    assert refusal(envelope(detections=twice)).startswith("detections.2.det_id: 'd' stands twice")


def test_a_det_id_equal_to_a_default_one_is_rejected() -> None:
    clash = [detection(det_id="run-a_kf1_d1"), detection()]
    assert "stands twice" in refusal(envelope(detections=clash))


def test_a_payload_over_the_limit_is_refused_before_it_is_read() -> None:
    raw = payload(envelope())
    assert refusal(raw, max_bytes=len(raw) - 1).startswith(f"payload of {len(raw)} bytes")
    assert isinstance(ingest(raw, max_bytes=len(raw)), Accepted)


def test_further_errors_are_counted() -> None:
    assert refusal({}) == "run_id: required field is missing (and 3 more)"


def test_a_reason_abbreviates_a_long_value() -> None:
    assert len(refusal(envelope(timestamp="x" * 10_000))) < 200


@pytest.mark.parametrize("value", [3e38, 1e-40])
def test_vectors_whose_squares_overflow_or_vanish_are_accepted(value: float) -> None:
    document = envelope(detections=[detection(vector=[value] * 512)])
    result = ingest(payload(document))
    assert isinstance(result, Accepted)
    (vector,) = result.vectors
    assert vector is not None
    assert vector.tolist() == [np.float32(value)] * 512


CAMERA = {"hfov_deg": 90.0, "width_px": 640, "height_px": 480.5}
MEASURED = {
    "depth_m": 2.5,
    "depth_sigma_m": 0.1,
    "position": [1.0, -2],
    "position_sigma_m": 0.25,
}


def test_a_camera_and_measured_depths_and_positions_are_accepted() -> None:
    result = ingest(payload(envelope(camera=CAMERA, detections=[detection(**MEASURED)])))
    assert isinstance(result, Accepted)
    camera, (seen,) = result.envelope.camera, result.envelope.detections
    assert camera is not None
    assert (camera.hfov_deg, camera.width_px, camera.height_px) == (90.0, 640.0, 480.5)
    assert camera.yaw_rad == 0.0
    assert (seen.depth_m, seen.depth_sigma_m) == (2.5, 0.1)
    assert (seen.position, seen.position_sigma_m) == ((1.0, -2.0), 0.25)
    assert has_evidence(result.envelope)


@pytest.mark.parametrize("fields", [{}, {"depth_sigma_m": 0.1}, {"position": None}])
def test_a_standard_error_alone_is_no_evidence(fields: dict[str, Any]) -> None:
    result = ingest(payload(envelope(camera=None, detections=[detection(**fields)])))
    assert isinstance(result, Accepted)
    assert not has_evidence(result.envelope)


@pytest.mark.parametrize(
    ("place", "value"),
    [
        ("depth_m", 0.0),
        ("depth_m", -1.0),
        ("depth_m", 1001.0),
        ("depth_m", "far"),
        ("depth_m", True),
        ("depth_sigma_m", 0.0),
        ("depth_sigma_m", 1e9),
        ("position", [1.0]),
        ("position", [1.0, 2.0, 3.0]),
        ("position", {"x": 1.0, "y": 2.0}),
        ("position", [1.1e7, 0.0]),
        ("position_sigma_m", 0.0009),
        ("position_sigma_m", [0.1]),
    ],
)
def test_a_wrong_depth_or_position_is_refused(place: str, value: Any) -> None:
    raw = payload(envelope(detections=[detection(**{**MEASURED, place: value})]))
    assert refusal(raw).startswith(f"detections.0.{place}")


@pytest.mark.parametrize(
    ("place", "value"),
    [
        ("hfov_deg", 0.5),
        ("hfov_deg", 171.0),
        ("hfov_deg", "90"),
        ("width_px", 0),
        ("width_px", 1e7),
        ("height_px", -1.0),
        ("yaw_rad", 7.1),
    ],
)
def test_a_wrong_camera_is_refused(place: str, value: Any) -> None:
    raw = payload(envelope(camera={**CAMERA, place: value}))
    assert refusal(raw).startswith(f"camera.{place}: ")


def test_a_camera_needs_its_size_and_field_of_view() -> None:
    for place in CAMERA:
        less = {name: value for name, value in CAMERA.items() if name != place}
        assert refusal(payload(envelope(camera=less))) == (
            f"camera.{place}: required field is missing"
        )
    assert refusal(payload(envelope(camera=[90.0]))).startswith("camera: ")
    for text in ("NaN", "Infinity"):
        raw = payload(envelope(camera={**CAMERA, "yaw_rad": "?"})).replace(b'"?"', text.encode())
        assert refusal(raw).startswith("camera.yaw_rad: ")


@pytest.mark.parametrize(
    ("value", "name"), [(2, "2"), ("2", "2"), (-1, "-1"), ("attic", "attic"), (None, None)]
)
def test_a_floor_is_a_name_or_a_number(value: Any, name: str | None) -> None:
    result = ingest(payload(envelope(floor=value, map_z=-2)))
    assert isinstance(result, Accepted)
    assert result.envelope.floor == name
    assert result.envelope.map_z == -2.0


@pytest.mark.parametrize("value", ["", "a" * 257, "a\nb", 1.5, True, [1], {"name": 1}, 2**63])
def test_a_wrong_floor_is_refused_with_the_field_and_the_value(value: Any) -> None:
    said = refusal(payload(envelope(floor=value)))
    assert said.startswith("floor: ")
    assert "(got " in said


@pytest.mark.parametrize("value", [1.1e7, "up", True, [0.0]])
def test_a_wrong_height_is_refused(value: Any) -> None:
    assert refusal(payload(envelope(map_z=value))).startswith("map_z: ")


_NINE = [0.04, 0.01, 0.0, 0.01, 0.09, 0.0, 0.0, 0.0, 0.02]


def _covariance(**changed: float) -> list[float]:
    """A covariance with these entries changed, by ``e`` and their index."""
    return [changed.get(f"e{at}", value) for at, value in enumerate(_NINE)]


@pytest.mark.parametrize(
    "nine",
    [
        _NINE,
        [0.0] * 9,
        _covariance(e1=0.06, e3=0.06),
        # what rounding leaves beside a variance of 0
        _covariance(e0=0.0, e1=1e-17, e3=-1e-17),
        [0.0, 0.0, 5.5e-195, 0.0, 0.0, 0.0, 5.5e-195, 0.0, 1.0],
    ],
)
def test_the_covariance_of_a_pose_is_taken(nine: list[float]) -> None:
    assert accepted(envelope(pose_covariance=nine)).envelope.pose_covariance == tuple(nine)
    assert accepted(envelope()).envelope.pose_covariance is None


@pytest.mark.parametrize(
    ("nine", "said"),
    [
        (_covariance(e0=-0.1), "variance -0.1 of x"),
        (_covariance(e8=2e6), "variance 2e+06 of yaw"),
        (_covariance(e1=0.02), "not symmetric: 0.02 and 0.01 for x and y"),
        (_covariance(e1=0.07, e3=0.07), "0.07 for x and y, more than their variances allow"),
        (_covariance(e0=0.0), "0.01 for x and y, more than their variances allow (0)"),
        (_covariance(e0=0.0, e1=1e-9, e3=1e-9), "1e-09 for x and y, more than their"),
        (_covariance(e4=float("nan")), "finite"),
        (_covariance(e2=float("inf")), "finite"),
        (_NINE[:8], "at least 9 items"),
        ([*_NINE, 0.0], "at most 9 items"),
        ([*_NINE[:8], "0.02"], "number"),
        ("none", "array"),
    ],
)
def test_what_is_no_covariance_is_refused_by_name_and_rule(nine: object, said: str) -> None:
    reason = refusal(envelope(pose_covariance=nine))
    assert reason.startswith("pose_covariance")
    assert said in reason
