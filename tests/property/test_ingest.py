"""Ingest answers every sequence of bytes, and keeps what a valid envelope says."""

import json
from typing import Any

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from eventsrc.base.text import visible
from eventsrc.envelope.ingest import Accepted, Rejected, ingest, ingest_all
from tests.support.envelopes import detection, envelope, payload

TEXT = st.text(st.characters(exclude_categories=["Cc", "Cs"]), min_size=1, max_size=256)
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)
FIELDS = st.sampled_from(["run_id", "keyframe_id", "timestamp", "map_x", "map_yaw", "detections"])


@given(st.binary(max_size=200))
def test_any_bytes_are_answered(raw: bytes) -> None:
    assert isinstance(ingest(raw), Accepted | Rejected)


# How fast such a tree of values is drawn says more about the machine's other work than about us.
@settings(suppress_health_check=[HealthCheck.too_slow])
@given(st.dictionaries(FIELDS, JSON, max_size=3))
def test_any_field_may_hold_any_json(fields: dict[str, Any]) -> None:
    result = ingest(payload({**envelope(), **fields}))
    assert isinstance(result, Accepted) or result.reason


NAMES = st.sampled_from(["det_id", "class", "class_name", "confidence", "bbox", "embedding", "x"])


@settings(suppress_health_check=[HealthCheck.too_slow])
@given(
    st.lists(st.dictionaries(NAMES, JSON, max_size=4) | JSON, max_size=3),
    st.sets(FIELDS, max_size=2),
    st.dictionaries(st.text(max_size=3), JSON, max_size=2),
)
def test_any_broken_envelope_is_refused_with_a_short_reason(
    detections: list[Any], missing: set[str], unknown: dict[str, Any]
) -> None:
    whole = {**unknown, **envelope(), "detections": [detection(), *detections]}
    result = ingest(payload({name: v for name, v in whole.items() if name not in missing}))
    assert isinstance(result, Accepted) or 0 < len(result.reason) < 400
    assert isinstance(result, Accepted) or result.reason == visible(result.reason)


@given(
    run_id=TEXT,
    keyframe_id=st.integers(-(2**63), 2**63 - 1),
    x=st.floats(-1e7, 1e7),
    y=st.floats(-1e7, 1e7),
    names=st.lists(TEXT, max_size=3),
)
def test_a_valid_envelope_is_accepted_unchanged(
    run_id: str, keyframe_id: int, x: float, y: float, names: list[str]
) -> None:
    sent = envelope(
        keyframe_id,
        x,
        y,
        run_id=run_id,
        timestamp=1.5,
        detections=[detection(name) for name in names],
    )
    read = ingest(payload(sent))
    assert isinstance(read, Accepted)
    assert read.envelope.run_id == run_id
    assert read.envelope.keyframe_id == keyframe_id
    assert (read.envelope.map_x, read.envelope.map_y) == (x, y)
    assert [d.class_name for d in read.envelope.detections] == names
    assert list(read.det_ids) == [f"{run_id}_kf{keyframe_id}_d{i}" for i in range(len(names))]


@given(st.binary(max_size=40))
def test_ascii_escapes_and_plain_utf8_read_the_same(noise: bytes) -> None:
    document = envelope(run_id="r🪑", note=noise.hex())
    assert ingest(json.dumps(document).encode()) == ingest(payload(document))


def _said(outcome: Accepted | Rejected) -> object:
    """Something to compare that looks at the vectors bit by bit."""
    if isinstance(outcome, Rejected):
        return outcome.reason
    vectors = [None if v is None else (v.shape, v.tobytes()) for v in outcome.vectors]
    return outcome.envelope, outcome.det_ids, vectors


VALUES = st.sampled_from([[1.0, 2.0, 3.0], [0.0, -1.0], [3.0, 4.0], [1e38, 1e38], [1e-30, 0.0]])
ODD = st.sampled_from(
    [
        {"embedding": "AAAAAAAAAAA=", "embedding_dim": 2},  # the zero vector
        {"embedding": "AADAfwAAgD8=", "embedding_dim": 2},  # NaN, 1
        {"embedding": "AACAPwAAgD8=", "embedding_dim": 3},
        {"embedding": "AACAPwAAgD8="},
        {"embedding": "AACA PwAAgD8=", "embedding_dim": 2},
        {"embedding": "é", "embedding_dim": 2},
        {"confidence": "high"},
        {"det_id": "twice"},
        {"class": "a\u0000b"},
    ]
)
GOOD = VALUES.map(lambda values: detection("cup", values)) | st.just(detection("cup"))
DETECTIONS = st.lists(GOOD | ODD.map(lambda odd: {**detection("cup"), **odd}), max_size=4)
PAYLOADS = st.binary(max_size=8) | DETECTIONS.map(
    lambda found: payload(envelope(7, 0.0, 0.0, detections=found))
)


@given(st.lists(PAYLOADS, max_size=5))
def test_together_each_is_answered_as_by_itself(payloads: list[bytes]) -> None:
    together = ingest_all(payloads)
    assert [_said(outcome) for outcome in together] == [_said(ingest(one)) for one in payloads]
