"""Questions: accepted forms, and how bad ones are refused."""

import json
import tracemalloc
from typing import Any

import numpy as np
import pytest

from projections.errors import QuestionError
from projections.relocalize import parse_question, read_crops
from projections.relocalize.question import MAX_CROPS
from tests.envelopes import MODEL, detection, embedding, envelope

VECTOR = [3.0, 4.0, 0.0]


def test_an_envelope_its_detections_and_crops_are_the_same_question() -> None:
    seen = [detection("cup", VECTOR, det_id="d0"), detection("chair", [0.0, 1.0, 0.0])]
    asked = [read_crops(q) for q in (envelope(1, detections=seen), seen, {"crops": seen})]
    for crops in asked:
        assert [c.class_name for c in crops] == ["cup", "chair"]
        assert crops[0].bbox == (120.0, 80.0, 250.0, 310.0)
        assert crops[0].det_id == "d0"
        assert crops[0].model == MODEL
        np.testing.assert_allclose(crops[0].vector, [0.6, 0.8, 0.0], atol=1e-6)


def test_a_crop_may_be_nothing_but_numbers() -> None:
    (crop,) = parse_question(b'{"crops": [{"embedding": [0, 2.5]}]}')
    assert crop.vector.tolist() == [0.0, 1.0]
    assert (crop.bbox, crop.class_name, crop.det_id, crop.model) == (None, None, None, None)


def test_crops_without_an_embedding_are_left_out() -> None:
    crops = read_crops([detection("cup"), detection("chair", VECTOR)])
    assert [c.class_name for c in crops] == ["chair"]


NAN = embedding([float("nan"), 1.0])


@pytest.mark.parametrize(
    ("question", "said"),
    [
        (b"\xff", "not JSON"),
        (b"[" * 10_000, "not JSON"),
        (b"{}\n{}\n", "more comes behind the question, in line 2; send one JSON document"),
        ({}, "neither an envelope"),
        ("text", "neither an envelope"),
        ([], "the question has no crops; send at least one"),
        ([detection("cup")], "the question has 1 crop and no embedding"),
        ([{"embedding": "###"}], "crops.0.embedding: not base64"),
        ([{"embedding": "AAA="}], "2 bytes, so no row"),
        ([{"embedding": []}], "is empty"),
        ([{"embedding": [0.0, 0.0]}], "only zeros"),
        ([NAN], "NaN"),
        ([{"embedding": [1e300]}], "NaN or infinity"),
        ([{"embedding": [1.0], "embedding_dim": 2}], "embedding_dim says 2"),
        ([{"embedding": [1.0], "bbox": [1, 2]}], "crops.0.bbox"),
        ([7], "crops.0: should be a JSON object"),
        ([{"embedding": 7}], "crops.0.embedding: input should be a valid list"),
        ([{"embedding": ["x"]}], "crops.0.embedding.0: input should be a valid number"),
        ([{"embedding": [10**400]}], "crops.0.embedding.0: input should be a"),
        ([{"embedding": [1.0] * 16_001}], "at most 16000 items"),
        ([embedding([1.0] * 16_001)], "crops.0.embedding_dim"),
        ([{"embedding": embedding([1.0] * 16_001)["embedding"]}], "16001 numbers, more than 16000"),
        ([{"embedding": "\ud800"}], "not base64"),
        ([{"embedding": [1.0], "class": "\ud800"}], "crops.0.class"),
        (b"[" + b"{}," * 30_000 + b"{}]", "30002 brackets and colons, more than 20000"),
        ([{"embedding": [1.0]}, {"embedding": [1.0, 2.0]}], "mixes embedding spaces (1, 2)"),
        ([{"embedding": [1.0]}] * (MAX_CROPS + 1), f"more than {MAX_CROPS}"),
    ],
    ids=lambda value: str(value)[:40],
)
def test_a_bad_question_is_refused_with_its_reason(question: Any, said: str) -> None:
    payload = question if isinstance(question, bytes) else json.dumps(question).encode()
    with pytest.raises(QuestionError, match=r".") as refused:
        parse_question(payload)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


WRONG = [b'""', b"{}", b"[]", b"null", b"true", b"1e400", b"9" * 999]


@pytest.mark.parametrize("wrong", WRONG, ids=lambda wrong: wrong.decode()[:5])
@pytest.mark.parametrize("field", [b"embedding", b"bbox", b"crops", b"detections"])
def test_validation_ends_at_the_first_wrong_item(field: bytes, wrong: bytes) -> None:
    """Pydantic's error for one wrong item takes 2 kB; a question has room for 300,000 of them."""
    items = b",".join([wrong] * (9_000 if len(wrong) < 9 else 900))
    asked = b'[{"%b":[%b]}]' if field in (b"embedding", b"bbox") else b'{"%b":[%b]}'
    tracemalloc.start()
    try:
        with pytest.raises(QuestionError):
            parse_question(asked % (field, items))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 3_000_000
