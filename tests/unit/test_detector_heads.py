"""Decoders against tensors made by hand, and against a loop over anchors."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from eventsrc.adapters.detector.heads import HEADS, HeadError

SIZE = (64, 32)


def _decode(head: str, answer: NDArray[Any], classes: int, least: float = 0.25) -> Any:
    return HEADS[head].decode(answer.astype(np.float32), SIZE, classes, least)


def test_yolov8_by_hand() -> None:
    answer = np.zeros((1, 4 + 3, 4))
    answer[0, :, 1] = [20, 10, 8, 4, 0.1, 0.9, 0.2]
    answer[0, :, 3] = [5, 6, 2, 2, 0.3, 0.1, 0.0]
    answer[0, :, 2] = [5, 6, 2, 2, 0.2, 0.2, 0.2]
    found = _decode("yolov8", answer, 3)
    assert found.boxes.tolist() == [[16, 8, 24, 12], [4, 5, 6, 7]]
    assert found.scores.tolist() == pytest.approx([0.9, 0.3])
    assert found.classes.tolist() == [1, 0]
    assert found.not_finite == 0


def test_yolov10_by_hand() -> None:
    answer = np.array([[[1, 2, 3, 4, 0.5, 2], [0, 0, 0, 0, 0.1, 0]]])
    found = _decode("yolov10", answer, 3)
    assert found.boxes.tolist() == [[1, 2, 3, 4]]
    assert (found.scores.tolist(), found.classes.tolist()) == ([0.5], [2])
    with pytest.raises(HeadError, match="names class 2 of 2; check --labels"):
        _decode("yolov10", answer, 2)


def _yolox_loop(answer: NDArray[Any], least: float) -> list[tuple[list[float], float, int]]:
    found = []
    row = 0
    for stride in (8, 16, 32):
        for y in range(SIZE[1] // stride):
            for x in range(SIZE[0] // stride):
                a = answer[0, row].tolist()
                row += 1
                scores = [a[4] * each for each in a[5:]]
                if max(scores) >= least:
                    cx, cy = (a[0] + x) * stride, (a[1] + y) * stride
                    w, h = math.exp(a[2]) * stride, math.exp(a[3]) * stride
                    box = [cx - w / 2, cy - h / 2, cx + w / 2, cy + h / 2]
                    found.append((box, max(scores), scores.index(max(scores))))
    assert row == answer.shape[1]
    return found


def _nanodet_loop(answer: NDArray[Any], classes: int, least: float) -> list[Any]:
    found = []
    row = 0
    for stride in (8, 16, 32, 64):
        for y in range(math.ceil(SIZE[1] / stride)):
            for x in range(math.ceil(SIZE[0] / stride)):
                a = answer[0, row].tolist()
                row += 1
                scores = a[:classes]
                if max(scores) >= least:
                    sides = []
                    for side in range(4):
                        bins = a[classes + 8 * side : classes + 8 * side + 8]
                        weights = [math.exp(b) for b in bins]
                        mean = sum(i * w for i, w in enumerate(weights)) / sum(weights)
                        sides.append(mean * stride)
                    at = (x * stride, y * stride)
                    box = [at[0] - sides[0], at[1] - sides[1], at[0] + sides[2], at[1] + sides[3]]
                    found.append((box, max(scores), scores.index(max(scores))))
    assert row == answer.shape[1]
    return found


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("head", "rows", "extra"), [("yolox", 42, 5), ("nanodet", 43, 32)])
def test_cells_against_a_loop(head: str, rows: int, extra: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    classes = 4
    answer = rng.normal(size=(1, rows, classes + extra)).astype(np.float32)
    scores = slice(4, None) if head == "yolox" else slice(0, classes)
    answer[:, :, scores] = rng.random(answer[:, :, scores].shape)
    expected = _yolox_loop(answer, 0.4) if head == "yolox" else _nanodet_loop(answer, classes, 0.4)
    found = _decode(head, answer, classes, 0.4)
    assert len(expected) > 3
    assert np.allclose(found.boxes, [box for box, _, _ in expected], atol=1e-3)
    assert np.allclose(found.scores, [score for _, score, _ in expected], atol=1e-6)
    assert found.classes.tolist() == [index for _, _, index in expected]


@pytest.mark.parametrize("head", sorted(HEADS))
@pytest.mark.parametrize("shape", [(1, 7), (1, 3, 3), (2, 84, 100), (), (1, 84, 100, 1)])
def test_another_shape_is_named(head: str, shape: tuple[int, ...]) -> None:
    with pytest.raises(HeadError, match=r"^it answers .* is 1 × "):
        _decode(head, np.zeros(shape), 80)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_counted_and_the_rest_is_kept(bad: float) -> None:
    answer = np.zeros((1, 4 + 2, 5))
    answer[0, 4, :] = 0.9
    answer[0, :4, :] = np.array([[10, 10, 4, 4]]).T
    answer[0, 2, 1] = answer[0, 5, 3] = bad
    found = _decode("yolov8", answer, 2)
    assert found.not_finite == 2
    assert len(found.boxes) == 3
    assert np.isfinite(found.boxes).all()


def test_sums_of_large_numbers_are_no_fault() -> None:
    answer = np.full((1, 4 + 1, 3), 3e38)
    answer[0, 4, :] = 0.5
    assert _decode("yolov8", answer, 1).not_finite == 0


def test_logits_are_no_scores() -> None:
    answer = np.zeros((1, 5, 2))
    answer[0, 4, 0] = 7.5
    with pytest.raises(HeadError, match=r"score of 7\.5, and scores are probabilities"):
        _decode("yolov8", answer, 1)


def test_a_huge_side_is_as_wide_as_any_picture_and_finite() -> None:
    answer = np.zeros((1, 42, 6))
    answer[0, 0] = [0, 0, 500, 3, 1, 1]
    found = _decode("yolox", answer, 1)
    assert np.isfinite(found.boxes).all()
    assert found.boxes[0, 2] > 1e6
