"""Questions: accepted forms, and how bad ones are refused."""

import json
import tracemalloc
from typing import Any

import numpy as np
import pytest

from eventsrc.envelope.readers import EnvelopeCamera
from projections.fold.map_errors import QuestionError
from projections.fold.settings import CameraConstants
from projections.localize.relocalize import (
    parse_question,
    question_schema,
    read_moved,
    read_question,
)
from projections.localize.relocalize.question import MAX_CROPS, MAX_VIEWS
from projections.surfaces.serve import answering, description
from tests.support.envelopes import MODEL, detection, embedding, envelope

VECTOR = [3.0, 4.0, 0.0]


def test_an_envelope_its_detections_and_crops_are_the_same_question() -> None:
    seen = [detection("cup", VECTOR, det_id="d0"), detection("chair", [0.0, 1.0, 0.0])]
    asked = [read_question(q).crops for q in (envelope(1, detections=seen), seen, {"crops": seen})]
    for crops in asked:
        assert [c.class_name for c in crops] == ["cup", "chair"]
        assert crops[0].bbox == (120.0, 80.0, 250.0, 310.0)
        assert crops[0].det_id == "d0"
        assert crops[0].model == MODEL
        np.testing.assert_allclose(crops[0].vector, [0.6, 0.8, 0.0], atol=1e-6)


def test_a_crop_may_be_nothing_but_numbers() -> None:
    (crop,) = parse_question(b'{"crops": [{"embedding": [0, 2.5]}]}').crops
    assert crop.vector is not None
    assert crop.vector.tolist() == [0.0, 1.0]
    assert (crop.bbox, crop.class_name, crop.det_id, crop.model) == (None, None, None, None)


def test_a_crop_without_an_embedding_is_one_of_its_class() -> None:
    crops = read_question(
        [detection("cup"), detection("chair", VECTOR), {"bbox": [1, 2, 3, 4]}]
    ).crops
    assert [c.class_name for c in crops] == ["cup", "chair"]
    assert [c.vector is None for c in crops] == [True, False]


def test_a_text_says_that_it_is_one() -> None:
    asked = [
        {"embedding": VECTOR, "text": True},
        {"embedding": VECTOR},
        {"class": "a", "text": True},
    ]
    assert [c.is_text for c in read_question(asked).crops] == [True, False, False]


def test_views_have_movements_between_them() -> None:
    seen = detection("cup", VECTOR)
    views = [
        {"dx": "not read", "crops": [seen]},
        {"dx": 1, "dy": -0.5, "dyaw": 3.0, "detections": [seen, seen]},
        {"dx": 0, "dy": 0, "dyaw": 0, "crops": []},
    ]
    question = read_question({"views": views, "crops": None})
    assert [len(view.crops) for view in question.views] == [1, 2, 0]
    moved = [(view.dx, view.dy, view.dyaw) for view in question.views]
    assert moved == [(0.0, 0.0, 0.0), (1.0, -0.5, 3.0), (0.0, 0.0, 0.0)]
    assert len(question.crops) == 3
    assert [crop for view in question.views for crop in view.crops] == list(question.crops)


def test_one_picture_is_one_view() -> None:
    (view,) = read_question([detection("cup", VECTOR)]).views
    assert (view.dx, view.dy, view.dyaw, len(view.crops)) == (0.0, 0.0, 0.0, 1)


def test_a_question_may_state_its_camera() -> None:
    camera = {"hfov_deg": 90, "width_px": 1280, "height_px": 720, "yaw_rad": 0.5}
    asked = envelope(1, detections=[detection("cup", VECTOR)], camera=camera)
    assert read_question(asked).camera == CameraConstants(
        width_px=1280.0, height_px=720.0, hfov_deg=90.0, yaw_rad=0.5
    )
    assert read_question([detection("cup", VECTOR)]).camera is None


def test_the_schema_holds_what_is_read() -> None:
    """Its examples in HTTP's description are questions."""
    schema = question_schema()
    moved = {"dx", "dy", "dyaw"}
    assert [set(form.get("properties", {})) for form in schema["anyOf"]] == [
        {"crops", "camera"} | moved,
        {"detections", "camera"} | moved,
        {"views", "camera"},
        set(),
    ]
    view = schema["anyOf"][2]["properties"]["views"]["items"]
    assert set(view["properties"]) == {"dx", "dy", "dyaw", "crops"}
    camera = schema["anyOf"][0]["properties"]["camera"]["anyOf"][0]
    assert set(camera["properties"]) == set(EnvelopeCamera.model_fields)
    crop = view["properties"]["crops"]["items"]
    assert set(crop["properties"]) == {
        "embedding",
        "embedding_dim",
        "embedding_model",
        "text",
        "class",
        "bbox",
        "det_id",
    }
    for form in description._EXAMPLES.values():
        assert read_question(json.loads(json.dumps(form["value"]))).crops


def test_the_service_says_what_else_it_reads() -> None:
    """Its options, at their limits, are read; beyond them they are refused."""
    body: Any = description.QUESTION["requestBody"]
    *forms, _ = body["content"]["application/json"]["schema"]["anyOf"]
    for form in forms:
        given = form["properties"]
        assert given["method"]["enum"] == ["joint", "plain"]
        asked = {
            **ONE,
            "top": given["top"]["maximum"],
            "session": "x" * given["session"]["anyOf"][0]["maxLength"],
        }
        read = answering._read(json.dumps(asked).encode(), {})
        assert (read.top, read.session) == (asked["top"], asked["session"])
        for key, wrong in (("top", asked["top"] + 1), ("session", asked["session"] + "x")):
            with pytest.raises(QuestionError, match=f"^{key} is "):
                answering._read(json.dumps({**asked, key: wrong}).encode(), {})


def test_a_view_may_repeat_the_camera_of_its_question() -> None:
    camera = {"hfov_deg": 90, "width_px": 1280, "height_px": 720}
    question = read_question({"views": [{**ONE, "camera": camera}], "camera": camera})
    assert question.camera == CameraConstants(width_px=1280.0, height_px=720.0, hfov_deg=90.0)


ONE = {"crops": [{"embedding": VECTOR}]}
MOVED = {"dx": 0.0, "dy": 0.0, "dyaw": 0.5, **ONE}
NAN = embedding([float("nan"), 1.0])


@pytest.mark.parametrize(
    ("question", "said"),
    [
        ({**ONE, "dx": 1.0}, "dy: is missing; give the metres and"),
        ({"views": [{**ONE, "dyaw": 1.0}]}, "views.0.dx: is missing"),
        ({**MOVED, "dx": "far"}, "dx: input should be a valid number"),
    ],
)
def test_a_movement_since_the_last_question_is_whole(question: Any, said: str) -> None:
    with pytest.raises(QuestionError, match=r".") as refused:
        read_moved(question)
    assert str(refused.value).startswith(said)
    assert "missing" not in said or str(refused.value).endswith("since the question before")


@pytest.mark.parametrize(
    ("question", "said"),
    [
        (b"\xff", "not JSON"),
        (b"[" * 10_000, "not JSON"),
        (b"{}\n{}\n", "there is more after the question, in line 2; send one JSON document"),
        ({}, "neither an envelope"),
        ("text", "neither an envelope"),
        ([], "the question has no crops with an embedding or a class; send at least one"),
        ([{"bbox": [1, 2, 3, 4]}], "no crops with an embedding or a class; send at least one"),
        ({"views": []}, "send a list of views"),
        ({"views": {}}, "send a list of views"),
        ({"views": [ONE], **ONE}, "has views and crops; send each crop in the view that shows it"),
        ({"views": [ONE], "detections": []}, "the question has views and detections"),
        ({"views": [ONE, {**MOVED, "camera": {}}]}, "views.1.camera: the views of a question have"),
        ({"views": [{**ONE, "camera": {}}], "camera": {"yaw_rad": 1}}, "views.0.camera: the views"),
        ({"views": [7]}, "views.0: should be a JSON object"),
        ({"views": [{"crops": [], "dx": 1.0}]}, "no crops with an embedding or a class"),
        ({"views": [ONE, ONE]}, "views.1.dx: is missing; give the metres and radians moved"),
        ({"views": [ONE, {**MOVED, "dyaw": None}]}, "views.1.dyaw: input should be a valid number"),
        ({"views": [ONE, {**MOVED, "dx": True}]}, "views.1.dx: input should be a valid number"),
        ({"views": [ONE, {**MOVED, "dx": 1e4}]}, "views.1.dx: input should be less than"),
        (b'{"views": [{"crops": [{"class": "a"}]}, {"dx": NaN, "dy": 0, "dyaw": 0}]}', "finite"),
        (b'{"views": [{"crops": [{"class": "a"}]}, {"dx": 0, "dy": 1e999, "dyaw": 0}]}', "finite"),
        ({"views": [ONE, {**MOVED, "crops": 7}]}, "views.1: the question is neither"),
        (
            {"views": [ONE, {**MOVED, "crops": [{"embedding": []}]}]},
            "views.1.crops.0.embedding: is",
        ),
        ({"views": [ONE] + [MOVED] * MAX_VIEWS}, f"9 views, more than {MAX_VIEWS}"),
        ({"views": [ONE, {**MOVED, "crops": [{"class": "a"}] * MAX_CROPS}]}, "32 crops in all its"),
        ({"views": [ONE, {**MOVED, "crops": [{"embedding": [1.0]}]}]}, "mixes embedding spaces"),
        ({**ONE, "camera": 7}, "camera: "),
        ({**ONE, "camera": {"hfov_deg": 0, "width_px": 1, "height_px": 1}}, "camera.hfov_deg: "),
        ([{"class": "a", "text": 1}], "crops.0.text: input should be a valid boolean"),
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
        ([{"embedding": [10**400]}], "a number of 401 digits, 1000"),
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
