"""Pictures under fusion by evidence: objects where they stand, ellipses, missing and moved ones."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.patches import Ellipse

from projections.adapters.drawing import HousePlan, draw_map
from projections.adapters.drawing.map_picture import EVIDENCE_LEGEND, LEGEND, compose
from projections.adapters.drawing.sheet import Sheet
from projections.adapters.scene import two_sigma
from projections.fold import deltas as d
from projections.fold.settings import Settings
from projections.map.records import EstimatedPosition
from projections.map.view import MapView

pytestmark = pytest.mark.seconds

EVIDENCE = Settings(fusion="evidence")
COVARIANCES = st.builds(
    lambda wide, high, angle: (
        np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        @ np.diag([wide, high])
    ),
    st.floats(0.01, 5.0),
    st.floats(0.01, 5.0),
    st.floats(0.0, math.pi),
).map(lambda root: root @ root.T)


def view_with(settings: Settings, *deltas: d.Delta) -> MapView:
    """A robot drives from (0, 0) to (4, 0) and sees a cup and a vase from (2, 0) twice."""
    view = MapView(settings)
    view.apply(d.RunSeen(0, 0, "run", 0.0))
    for index in range(5):
        pose = d.Pose(index * 1_000_000, 0, 0.0)
        view.apply(d.KeyframeAdded(index, index, 0, "run", index, float(index), pose))
    for number, name in enumerate(("cup", "vase")):
        box = (0.0, 0.0, 1.0, 1.0)
        view.apply(
            d.ObservationAdded(
                *(2, number, 2, "run", 2, f"d{number}", name, 0.9, box, None, None, False),
                measured=True,
            )
        )
        view.apply(d.ObjectFound(2, number, f"obj-{number}", name, number))
        view.apply(d.ObjectSeen(2, number, number, 0, 2, 4_000_000, 0, 0.0, 0.0))
    for delta in deltas:
        view.apply(delta)
    view.advance(d.Offset(5))
    return view


CUP = d.ObjectEstimated(3, 0, 1_000_000, 1_500_000, 90_000_000_000, 0, 40_000_000_000, 3)
VASE = d.ObjectEstimated(3, 1, 3_000_000, 9_000_000, 10_000_000_000, 0, 40_000_000_000, 2)


def texts(sheet: Sheet) -> list[str]:
    return [text.get_text() for text in (*sheet.axes.texts, *sheet.figure.texts)]


def ellipses(sheet: Sheet) -> list[Ellipse]:
    return [patch for patch in sheet.axes.patches if isinstance(patch, Ellipse)]


def diamonds(sheet: Sheet) -> list[tuple[float, float]]:
    """Where points that are 15 square points large are, which only objects are."""
    return [
        (float(x), float(y))
        for found in sheet.axes.collections
        if list(getattr(found, "get_sizes", list)()) == [15]
        for x, y in found.get_offsets()
    ]


def test_objects_are_where_they_stand_with_their_ellipse() -> None:
    sheet = compose(view_with(EVIDENCE, CUP, VASE), "", HousePlan())
    assert sorted(diamonds(sheet)) == [(1.0, 1.5), (3.0, 9.0)]
    shapes = {tuple(e.get_center()): (e.get_width(), e.get_height()) for e in ellipses(sheet)}
    assert shapes[1.0, 1.5] == pytest.approx((4 * 0.3, 4 * 0.2))
    assert sorted(shapes[3.0, 9.0]) == pytest.approx([4 * 0.1, 4 * 0.2])
    assert all(e.get_linestyle() in ("-", "solid") for e in ellipses(sheet))
    assert EVIDENCE_LEGEND in texts(sheet)


def test_the_canvas_reaches_to_objects_beyond_the_drive() -> None:
    _, _, _, top = compose(view_with(EVIDENCE, CUP, VASE), "", HousePlan()).bounds
    assert top > 9.0
    _, _, _, without = compose(view_with(EVIDENCE, CUP), "", HousePlan()).bounds
    assert without < 3.0


def test_objects_without_an_estimate_are_where_the_robot_saw_them_from() -> None:
    sheet = compose(view_with(EVIDENCE), "", HousePlan())
    assert diamonds(sheet) == [(2.0, 0.0), (2.0, 0.0)]
    assert ellipses(sheet) == []


def test_the_picture_of_the_page_has_no_ellipse() -> None:
    sheet = compose(view_with(Settings()), "", HousePlan())
    assert diamonds(sheet) == [(2.0, 0.0), (2.0, 0.0)]
    assert ellipses(sheet) == []
    assert LEGEND in texts(sheet)
    assert EVIDENCE_LEGEND not in texts(sheet)


def test_a_missing_object_is_hollow_and_dashed() -> None:
    view = view_with(EVIDENCE, CUP, VASE, d.ObjectMissing(4, 1, 0, 6, True))
    sheet = compose(view, "", HousePlan())
    assert {"cup", "vase (missing)"} <= set(texts(sheet))
    lines = {tuple(e.get_center()): e.get_linestyle() for e in ellipses(sheet)}
    assert lines[1.0, 1.5] in ("-", "solid")
    assert lines[3.0, 9.0] not in ("-", "solid")
    found = compose(view_with(EVIDENCE, CUP, VASE), "", HousePlan())
    assert "vase" in texts(found)


def test_missing_and_present_objects_of_a_class_have_labels_of_their_own() -> None:
    again = d.ObjectEstimated(3, 1, 1_100_000, 1_500_000, 10_000_000, 0, 10_000_000, 2)
    view = view_with(EVIDENCE, CUP, again, d.ObjectClassified(3, 1, "cup"))
    assert "cup ×2" in texts(compose(view, "", HousePlan()))
    view.apply(d.ObjectMissing(4, 1, 0, 6, True))
    assert {"cup", "cup (missing)"} <= set(texts(compose(view, "", HousePlan())))


def test_a_wide_ellipse_is_faint() -> None:
    unsure = d.ObjectEstimated(3, 1, 3_000_000, 0, 10_000_000_000, 0, 640_000_000_000, 1)
    alphas = {
        tuple(e.get_center()): e.get_alpha()
        for e in ellipses(compose(view_with(EVIDENCE, CUP, unsure), "", HousePlan()))
    }
    assert 0 < alphas[3.0, 0.0] < alphas[1.0, 1.5]


def test_the_name_of_a_room_keeps_clear_of_the_objects_in_its_corners() -> None:
    plan = HousePlan(rooms=(("kitchen", (0.0, 0.0, 4.0, 4.0)),))
    texts_before = compose(view_with(EVIDENCE), "", plan).axes.texts
    (corner,) = [t.get_position() for t in texts_before if t.get_text() == "kitchen"]
    there = round(corner[0] * 1e6), round(corner[1] * 1e6)
    standing = d.ObjectEstimated(3, 0, *there, 10_000_000, 0, 10_000_000, 2)
    texts_then = compose(view_with(EVIDENCE, standing), "", plan).axes.texts
    (then,) = [t.get_position() for t in texts_then if t.get_text() == "kitchen"]
    assert math.dist(then, corner) > 1.0


def test_an_arrow_leads_from_where_a_moved_object_stood() -> None:
    moved = d.ObjectRelocated(4, 0, 0, 3_000_000, -500_000, 1_000_000, 1_500_000)
    sheet = compose(view_with(EVIDENCE, CUP, moved), "", HousePlan())
    arrows = [a for a in sheet.axes.texts if getattr(a, "arrow_patch", None) is not None]
    assert [(a.xy, a.get_position()) for a in arrows] == [((1.0, 1.5), (3.0, -0.5))]


@pytest.mark.parametrize("suffix", ["png", "svg"])
def test_the_same_map_gives_the_same_bytes(tmp_path: Path, suffix: str) -> None:
    one, two = tmp_path / f"one.{suffix}", tmp_path / f"two.{suffix}"
    for out in (one, two):
        draw_map(view_with(EVIDENCE, CUP, VASE), out, title="t")
    assert one.read_bytes() == two.read_bytes()


@given(COVARIANCES, st.floats(0.0, 2 * math.pi))
def test_the_ellipse_is_two_standard_errors_in_every_direction(
    covariance: np.ndarray, turn: float
) -> None:
    xx, xy, yy = (round(v * 1e12) for v in (covariance[0, 0], covariance[0, 1], covariance[1, 1]))
    width, height, angle_deg = two_sigma(EstimatedPosition(0, 0, xx, xy, yy, 1))
    angle = math.radians(angle_deg)
    along, across = width / 2 * math.cos(turn), height / 2 * math.sin(turn)
    point = np.array(
        [
            along * math.cos(angle) - across * math.sin(angle),
            along * math.sin(angle) + across * math.cos(angle),
        ]
    )
    distance2 = point @ np.linalg.solve(np.array([[xx, xy], [xy, yy]]) / 1e12, point)
    assert distance2 == pytest.approx(4.0, rel=1e-4)
