"""Detectors and encoders as ONNX models with known weights, good and bad ones."""

import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from onnx import TensorProto

from eventsrc.adapters.detector import vision
from eventsrc.adapters.detector.onnx_model import ModelError, OnnxModel
from eventsrc.adapters.detector.vision import Scaling, planes
from eventsrc.adapters.detector.vision_models import (
    COCO,
    Encoder,
    Finder,
    FinderOptions,
    read_labels,
    read_preparation,
)
from eventsrc.base.errors import MisuseError
from tests.support.models import (
    DIMENSION,
    Graph,
    colour_detector,
    fixed_answer,
    mean_colour_encoder,
)

RED, BLUE = (255, 0, 0), (0, 64, 255)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("models")


@pytest.fixture(scope="module")
def finder(folder: Path) -> Finder:
    model = colour_detector(folder / "d.onnx", [(RED, "cup"), (BLUE, "couch")], (320, 320))
    return Finder(OnnxModel(model, threads=1), None, FinderOptions())


def _picture(width: int, height: int, *boxes: tuple[tuple[int, int, int], list[int]]) -> Any:
    pixels = np.full((height, width, 3), 150, np.uint8)
    for (red, green, blue), (x0, y0, x1, y1) in boxes:
        pixels[y0:y1, x0:x1] = (blue, green, red)
    return pixels


@pytest.mark.parametrize(("width", "height"), [(320, 320), (640, 400), (400, 640), (1920, 1080)])
def test_boxes_come_out_where_they_are(finder: Finder, width: int, height: int) -> None:
    """Within the stride of the model, four of its pixels, on each side."""
    cup = [width // 8, height // 8, width // 2, height // 2]
    couch = [width // 2, height // 2, width - 9, height - 7]
    found = finder.find(_picture(width, height, (RED, cup), (BLUE, couch)))
    boxes = dict(zip(found.labels, found.boxes.tolist(), strict=True))
    step = 4 * max(width, height) / 320
    assert np.abs(np.array(boxes["cup"]) - cup).max() <= step
    assert np.abs(np.array(boxes["couch"]) - couch).max() <= step
    assert found.scores == sorted(found.scores, reverse=True)
    assert found.labels[0] in ("cup", "couch")
    assert (found.not_finite, found.too_small, found.cut) == (0, 0, 0)


def test_nothing_is_found_on_grey(finder: Finder) -> None:
    assert finder.find(_picture(64, 48)).labels == []


def test_a_picture_of_another_shape_leaves_nothing_behind(finder: Finder) -> None:
    """The input's memory is used again: a tall red picture must not show beside a wide one."""
    finder.find(_picture(100, 400, (RED, [0, 0, 100, 400])))
    assert finder.find(_picture(400, 100)).labels == []


def _answer(columns: int, *anchors: list[float]) -> Any:
    answer = np.zeros((1, 5, columns), np.float32)
    for index, anchor in enumerate(anchors):
        answer[0, :, index] = anchor
    return answer


def _fixed(folder: Path, answer: Any, **options: Any) -> Finder:
    model = fixed_answer(folder / "fixed.onnx", answer)
    return Finder(OnnxModel(model, threads=1), ["thing"], FinderOptions(**options))


def test_faults_of_an_answer_are_counted(folder: Path) -> None:
    nan, inf = math.nan, math.inf
    finder = _fixed(
        folder,
        _answer(
            8,
            [32, 32, 10, 10, 0.9],
            [32, 32, 0, 0, 0.8],  # no size
            [500, 500, 10, 10, 0.8],  # outside
            [nan, 32, 10, 10, 0.8],
            [32, 32, inf, 10, 0.8],
            [32, 32, 10, 10, nan],
            [32, 32, -10, 10, 0.8],  # inside out
        ),
    )
    found = finder.find(np.zeros((64, 64, 3), np.uint8))
    assert found.boxes.tolist() == [[27, 27, 37, 37]]
    assert (found.not_finite, found.too_small, found.cut) == (3, 3, 0)


def test_ten_thousand_boxes_are_cut_to_the_most(folder: Path) -> None:
    rng = np.random.default_rng(3)
    answer = np.zeros((1, 5, 10_000), np.float32)
    answer[0, :2] = rng.random((2, 10_000)) * 64
    answer[0, 2:4] = 1.5
    answer[0, 4] = np.linspace(0.3, 0.99, 10_000)
    found = _fixed(folder, answer, most=100).find(np.zeros((64, 64, 3), np.uint8))
    assert len(found.labels) == 100
    assert found.cut > 1000
    assert found.scores[0] == pytest.approx(0.99)


@pytest.mark.parametrize(
    ("shape", "reason"),
    [
        ((1, 84, 10), r"it answers 1 × 84 × 10, and yolov8 of 1 classes is 1 × 5 × N; check"),
        ((1, 5), "it answers 1 × 5, and yolov8 of 1 classes"),
        ((1, 10, 6), "try --head yolov10"),
        ((1, 10, 33), "try --head nanodet"),
    ],
)
def test_an_answer_of_another_shape_ends_it_with_a_line(
    folder: Path, shape: tuple[int, ...], reason: str
) -> None:
    with pytest.raises(ModelError, match=reason) as caught:
        _fixed(folder, np.zeros(shape, np.float32))
    assert "\n" not in str(caught.value)


def test_what_is_no_model(folder: Path) -> None:
    with pytest.raises(MisuseError, match="no such model"):
        OnnxModel(folder / "none.onnx")
    for name, data in (("text.onnx", b"hello"), ("empty.onnx", b""), ("zeros.onnx", bytes(1000))):
        (folder / name).write_bytes(data)
        with pytest.raises(ModelError, match="cannot be loaded as ONNX") as caught:
            OnnxModel(folder / name)
        assert "\n" not in str(caught.value)
    good = colour_detector(folder / "whole.onnx", [(RED, "cup")], (64, 64)).read_bytes()
    (folder / "cut.onnx").write_bytes(good[: len(good) // 2])
    with pytest.raises(ModelError, match="cannot be loaded as ONNX"):
        OnnxModel(folder / "cut.onnx")


def _identity(path: Path, shape: tuple[int | str, ...], kind: int = TensorProto.FLOAT) -> Path:
    g = Graph()
    return g.save(path, {"x": shape}, {"y": shape}, {"y": "x"}, kind=kind)


@pytest.mark.parametrize("shape", [(1, 3), (1, 4, 8, 8), ("n",)])
def test_a_model_that_takes_no_pictures(folder: Path, shape: tuple[int | str, ...]) -> None:
    with pytest.raises(ModelError, match="n × 3 × height × width of float is needed"):
        OnnxModel(_identity(folder / "other.onnx", shape))


def test_a_model_that_takes_texts_too(folder: Path) -> None:
    g = Graph()
    both = g.add("Add", "pixel_values", "input_ids")
    shape = (1, 3, 8, 8)
    path = g.save(
        folder / "two.onnx", {"pixel_values": shape, "input_ids": shape}, {"y": shape}, {"y": both}
    )
    with pytest.raises(ModelError, match=r"pixel_values, input_ids; .* export the image tower"):
        OnnxModel(path)


def test_half_precision_and_an_open_size_work(folder: Path) -> None:
    g = Graph()
    mean = g.add("ReduceMean", "x", axes=[2, 3], keepdims=0)
    path = g.save(
        folder / "half.onnx",
        {"x": ("n", 3, "h", "w")},
        {"y": ("n", 3)},
        {"y": mean},
        kind=TensorProto.FLOAT16,
    )
    preparation = {"model": "half", "size": [6, 4], "mean": [0, 0, 0], "std": [1, 1, 1]}
    path.with_suffix(".json").write_text(json.dumps(preparation))
    encoder = Encoder(OnnxModel(path), read_preparation(path))
    (vector,) = encoder.encode([_picture(9, 9, (RED, [0, 0, 9, 9]))])
    assert vector is not None
    assert np.allclose(vector, [1, 0, 0], atol=1e-3)


@pytest.fixture(scope="module")
def encoder(folder: Path) -> Encoder:
    model = mean_colour_encoder(folder / "e.onnx")
    return Encoder(OnnxModel(model, threads=1), read_preparation(model))


def test_crops_are_encoded_in_their_order_however_they_are_batched(
    folder: Path, encoder: Encoder
) -> None:
    rng = np.random.default_rng(1)
    crops = [rng.integers(0, 255, (*rng.integers(1, 60, 2), 3), np.uint8) for _ in range(70)]
    together = encoder.encode(crops)
    fixed = mean_colour_encoder(folder / "fixed_batch.onnx", batch=4)
    others = [
        [v for crop in crops for v in encoder.encode([crop])],
        Encoder(OnnxModel(fixed), read_preparation(fixed)).encode(crops),
    ]
    assert len(together) == 70
    for vectors in others:
        for one, other in zip(together, vectors, strict=True):
            assert one is not None
            assert other is not None
            assert one.shape == (DIMENSION,)
            assert np.allclose(one, other, atol=1e-5)
            assert np.linalg.norm(one) == pytest.approx(1.0)


def test_the_tiny_encoder_sees_hues_and_no_grey(encoder: Encoder) -> None:
    alone = _picture(40, 40, (RED, [0, 0, 40, 40]))
    beside_grey = _picture(40, 40, (RED, [0, 0, 20, 40]))
    other = _picture(40, 40, (BLUE, [0, 0, 40, 40]))
    a, b, c = encoder.encode([alone, beside_grey, other])
    assert a is not None
    assert b is not None
    assert c is not None
    assert float(a @ b) > 0.999
    assert float(a @ c) < 0.0


@pytest.mark.parametrize("value", [math.nan, math.inf, 0.0])
def test_an_answer_that_is_no_vector_is_none(folder: Path, value: float) -> None:
    g = Graph()
    zero = g.add("Mul", g.add("ReduceMean", "x", axes=[2, 3], keepdims=0), g.constant(0.0))
    answer = g.add("Add", zero, g.constant(value))
    path = g.save(folder / "bad.onnx", {"x": ("n", 3, 8, 8)}, {"y": ("n", 3)}, {"y": answer})
    preparation = {"model": "bad", "size": 8, "mean": [0, 0, 0], "std": [1, 1, 1]}
    path.with_suffix(".json").write_text(json.dumps(preparation))
    encoder = Encoder(OnnxModel(path), read_preparation(path))
    assert encoder.encode([_picture(9, 9)] * 2) == [None, None]


def test_an_answer_that_is_no_list_of_vectors(folder: Path) -> None:
    path = _identity(folder / "tokens.onnx", ("n", 3, 8, 8))
    preparation = {"model": "tokens", "size": 8, "mean": [0, 0, 0], "std": [1, 1, 1]}
    path.with_suffix(".json").write_text(json.dumps(preparation))
    with pytest.raises(ModelError, match="output y is 1 × 3 × 8 × 8 for 1 crops; one vector"):
        Encoder(OnnxModel(path), read_preparation(path))


GOOD = {"model": "m", "size": 32, "mean": [0.5, 0.5, 0.5], "std": [0.5, 0.5, 0.5]}


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (None, "No such file"),
        ("{", "Invalid JSON"),
        ({"size": 0}, "size"),
        ({"size": "big"}, "size"),
        ({"std": [0.5, 0.0, 0.5]}, "std.1"),
        ({"mean": [0.5]}, "mean"),
        ({"resize": "magic"}, "resize"),
        ({"model": "a\nb"}, "model"),
        ({"speed": 1}, "speed: no such field;"),
        ({"mean": [0.5, "x", 0.5]}, "mean.1"),
    ],
)
def test_a_wrong_preparation_is_one_line(tmp_path: Path, change: Any, reason: str) -> None:
    if change is not None:
        text = change if isinstance(change, str) else json.dumps(GOOD | change)
        (tmp_path / "e.json").write_text(text)
    with pytest.raises(MisuseError) as caught:
        read_preparation(tmp_path / "e.onnx")
    message = str(caught.value)
    assert reason in message
    assert "docs/detector.md" in message
    assert "\n" not in message


def test_a_batch_that_no_memory_holds_is_refused(folder: Path) -> None:
    model = mean_colour_encoder(folder / "batch.onnx", batch=10_000_000)
    with pytest.raises(ModelError, match="takes 10,000,000 crops of 1,024 pixels at once"):
        Encoder(OnnxModel(model), read_preparation(model))


def test_a_size_that_the_model_does_not_have(folder: Path) -> None:
    model = mean_colour_encoder(folder / "sized.onnx", size=16)
    model.with_suffix(".json").write_text(json.dumps(GOOD))
    with pytest.raises(ModelError, match=r"the size in sized\.json is 32 × 32"):
        Encoder(OnnxModel(model), read_preparation(model))


def test_labels(tmp_path: Path, folder: Path) -> None:
    assert len(read_labels("coco")) == len(COCO.split()) == 80
    assert read_labels("coco")[58] == "potted plant"
    file = tmp_path / "labels.txt"
    file.write_text("cup\ntraffic light\n\n")
    assert read_labels(str(file)) == ("cup", "traffic light")
    file.write_text('["a", "b"]')
    assert read_labels(str(file)) == ("a", "b")
    for text, reason in (
        ("", "no list of classes"),
        ("a\n\nb", "class 2 is ''"),
        ("a\tb", "class 1 is"),
        ('["a", 1]', "class 2 is 1"),
        ("[", "no JSON list"),
    ):
        file.write_text(text)
        with pytest.raises(MisuseError, match=reason):
            read_labels(str(file))
    g = Graph()
    metadata = {"names": "{[]: 1}"}
    unreadable = g.save(
        folder / "names.onnx",
        {"images": (1, 3, 64, 64)},
        {"output0": (1, 3, 64, 64)},
        {"output0": "images"},
        metadata=metadata,
    )
    with pytest.raises(MisuseError, match="the classes in its metadata: no list of classes"):
        Finder(OnnxModel(unreadable), None, FinderOptions())
    with pytest.raises(MisuseError, match="give a file, or coco"):
        read_labels(str(tmp_path / "none"))
    unnamed = fixed_answer(folder / "unnamed.onnx", np.zeros((1, 5, 1), np.float32))
    with pytest.raises(MisuseError, match="does not name its classes"):
        Finder(OnnxModel(unnamed), None, FinderOptions())


@pytest.mark.parametrize("rgb", [False, True])
def test_pixels_are_scaled_channel_by_channel(rgb: bool) -> None:
    rng = np.random.default_rng(5)
    pictures = [rng.integers(0, 255, (5, 7, 3), np.uint8) for _ in range(3)]
    mean, std = (0.1, 0.2, 0.3), (0.5, 0.6, 0.7)
    out = planes(pictures, Scaling.of(rgb=rgb, scale=1 / 255, mean=mean, std=std))
    for n, c, y, x in np.ndindex(3, 3, 5, 7):
        value = float(pictures[n][y, x, 2 - c if rgb else c]) / 255
        assert out[n, c, y, x] == pytest.approx((value - mean[c]) / std[c], abs=1e-5)


class _Interrupted:
    """Imports as pybind11 does where Ctrl-C comes meanwhile."""

    def find_spec(self, name: str, *_: object) -> None:
        if name == "onnxruntime":
            raise ImportError("initialization failed") from KeyboardInterrupt()


def test_ctrl_c_while_onnxruntime_is_imported_is_no_missing_library(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = mean_colour_encoder(folder / "interrupted.onnx")
    monkeypatch.delitem(sys.modules, "onnxruntime", raising=False)
    monkeypatch.setattr(sys, "meta_path", [_Interrupted(), *sys.meta_path])
    with pytest.raises(KeyboardInterrupt):
        OnnxModel(model)


def test_a_missing_library_names_the_extra(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = mean_colour_encoder(folder / "extra.onnx")
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(MisuseError, match=r"pip install 'mapfold\[detector\]'"):
        OnnxModel(model)
    vision._cv2.cache_clear()
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(MisuseError, match=r"pip install 'mapfold\[detector\]'"):
        vision.check_installed()
    monkeypatch.undo()
    vision.check_installed()
