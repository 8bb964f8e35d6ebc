"""Map pictures: their texts, the same bytes each time, refusals."""

import re
import struct
from collections.abc import Iterable
from pathlib import Path

import pytest

from eventsrc.adapters.sim import build_house
from eventsrc.base.errors import MisuseError
from projections.adapters.drawing import HousePlan, LostRobot, MergeMark, Spot, draw_map, plan_of
from projections.adapters.drawing.map_picture import compose, legend_lines
from projections.adapters.drawing.sheet import Sheet
from projections.adapters.scene import objects_of, objects_shown, place_colour
from projections.fold import deltas as d
from projections.fold.settings import Settings
from projections.map.view import MapView

pytestmark = pytest.mark.seconds


def _two_places() -> MapView:
    """Ten keyframes along a line; the first five are p0, the last four p1, one between is noise."""
    view = MapView(Settings())
    view.apply(d.RunSeen(0, 0, "run", 0.0))
    for index in range(10):
        pose = d.Pose(index * 1_000_000, 500_000, 0.0)
        view.apply(d.KeyframeAdded(index, index, 0, "run", index, float(index), pose))
    view.apply(d.PlaceFormed(4, 0, "run_p0", 0))
    view.apply(d.PlaceFormed(9, 1, "run_p1", 6))
    for index in (0, 1, 2, 3, 4):
        view.apply(d.KeyframePlaced(index, index, 0))
    for index in (6, 7, 8, 9):
        view.apply(d.KeyframePlaced(index, index, 1))
    view.apply(d.PlaceChanged(4, 0, 5, 10_000_000, 2_500_000))
    view.apply(d.PlaceChanged(9, 1, 4, 30_000_000, 2_000_000))
    view.apply(d.PlacesLinked(9, 0, 1, 37))
    for number, (name, count) in enumerate([("cup & saucer", 2), ("<vase>", 3), ("rare", 1)]):
        box = (0.0, 0.0, 1.0, 1.0)
        view.apply(
            d.ObservationAdded(
                *(number, number, 2, "run", 2, f"d{number}", name, 0.9, box, None, None, False),
                measured=count > 1,
            )
        )
        view.apply(d.ObjectFound(2, number, f"obj-{number}", name, number))
        view.apply(
            d.ObjectSeen(2, number, number, 0, count, count * 2_000_000, count * 500_000, 0.0, 0.0)
        )
        view.apply(d.ObjectMoved(2, number, 0))
    view.advance(10)
    return view


def _texts(sheet: Sheet) -> list[str]:
    return [text.get_text() for text in (*sheet.axes.texts, *sheet.figure.texts)]


def test_the_picture_names_places_objects_and_transitions() -> None:
    texts = _texts(compose(_two_places(), "a title", HousePlan()))
    assert {"a title", "p0", "p1", "37", "cup & saucer", "<vase>"} <= set(texts)
    assert "rare" not in texts  # seen once
    assert any("2 places  ·  2 objects + 1 seen once  ·" in text for text in texts)


def test_objects_seen_once_are_shown_when_all_are_asked_for() -> None:
    view = _two_places()
    texts = _texts(compose(view, "", HousePlan(), objects=objects_shown(view, everything=True)))
    assert "rare" in texts
    assert any("2 objects + 1 seen once, 3 shown  ·" in text for text in texts)
    often = objects_shown(view, everything=True, min_observations=3)
    assert [found.class_name for found in often] == ["<vase>"]
    assert [shown.label for shown in objects_of(view)] == ["cup & saucer", "<vase>"]
    assert [shown.label for shown in objects_of(view, everything=True)][2:] == ["rare"]


def test_names_of_places_carry_the_run_where_two_runs_have_the_same() -> None:
    view = _two_places()
    view.apply(d.RunSeen(10, 1, "other", 0.0))
    view.apply(d.PlaceFormed(10, 2, "other_p1", 9))
    texts = _texts(compose(view, "", HousePlan()))
    assert {"p0", "run_p1", "other_p1"} <= set(texts)


def test_a_place_with_a_name_shows_it_instead_of_its_id() -> None:
    view = _two_places()
    view.apply(d.PlaceNamed(10, 0, "Ann's kitchen", 10))
    texts = set(_texts(compose(view, "", HousePlan())))
    assert {"Ann's kitchen", "p1"} <= texts
    assert "p0" not in texts


def test_places_that_share_a_name_show_their_ids_too() -> None:
    view = _two_places()
    view.apply(d.PlaceNamed(10, 0, "office", 10))
    view.apply(d.PlaceNamed(10, 1, "office", 11))
    assert {"office (p0)", "office (p1)"} <= set(_texts(compose(view, "", HousePlan())))
    view.apply(d.PlaceNamed(10, 1, "p0", 12))  # one is called as another's id is
    assert {"office", "p0 (p1)"} <= set(_texts(compose(view, "", HousePlan())))


def test_a_long_name_is_cut() -> None:
    view = _two_places()
    view.apply(d.PlaceNamed(10, 0, "the room behind the second kitchen", 10))
    assert "the room behind the sec…" in _texts(compose(view, "", HousePlan()))


def test_objects_of_one_class_far_apart_keep_labels_of_their_own() -> None:
    view = _two_places()
    box = (0.0, 0.0, 1.0, 1.0)
    seen = (3, 3, 4, "run", 4, "d3", "<vase>", 0.9, box, None, None, False)
    view.apply(d.ObservationAdded(*seen, measured=True))
    view.apply(d.ObjectFound(4, 3, "obj-3", "<vase>", 3))
    view.apply(d.ObjectSeen(4, 3, 3, 0, 2, 8_000_000, 1_000_000, 0.0, 0.0))
    view.apply(d.ObjectMoved(4, 3, 0))
    assert _texts(compose(view, "", HousePlan())).count("<vase>") == 2


def test_objects_of_one_class_in_one_place_share_a_label() -> None:
    view = _two_places()
    box = (0.0, 0.0, 1.0, 1.0)
    seen = (3, 3, 3, "run", 3, "d3", "<vase>", 0.9, box, None, None, False)
    view.apply(d.ObservationAdded(*seen, measured=True))
    view.apply(d.ObjectFound(3, 3, "obj-3", "<vase>", 3))
    view.apply(d.ObjectSeen(3, 3, 3, 0, 2, 6_000_000, 1_000_000, 0.0, 0.0))
    view.apply(d.ObjectMoved(3, 3, 0))
    assert "<vase> ×2" in _texts(compose(view, "", HousePlan()))


def test_the_house_the_lost_robot_and_the_bridge_are_on_it() -> None:
    house = build_house(7)
    sheet = compose(
        _two_places(),
        "",
        plan_of(house),
        LostRobot(Spot(2, 1, 0.3), Spot(3, 1), 0.5),
        [MergeMark(5.0, 0.5, "p0 took in p2")],
    )
    texts = _texts(sheet)
    assert {room.name for room in house.plan.rooms} | {"p0 took in p2"} <= set(texts)
    assert any("lost robot" in text for text in texts)


def _add_objects(view: MapView, names: Iterable[str]) -> None:
    """Objects of these classes, from number 3 on, all at one spot."""
    box = (0.0, 0.0, 1.0, 1.0)
    for number, name in enumerate(names, start=3):
        view.apply(
            d.ObservationAdded(
                *(number, number, 0, "run", 0, f"d{number}", name, 0.9, box, None, None, False),
                measured=True,
            )
        )
        view.apply(d.ObjectFound(2, number, f"obj-{number}", name, number))
        view.apply(d.ObjectSeen(2, number, number, 0, 2, 4_000_000, 1_000_000, 0.0, 0.0))


@pytest.mark.slow
def test_labels_that_find_no_room_are_counted_on_the_picture() -> None:
    view = _two_places()
    _add_objects(view, (f"a rather long class name {number}" for number in range(3, 300)))
    texts = _texts(compose(view, "", HousePlan()))
    drawn = sum(text.startswith("a rather long") for text in texts)
    assert 0 < drawn < 297
    assert any(f"{297 - drawn} object labels had no room" in text for text in texts)


def test_one_label_without_room_is_singular() -> None:
    assert legend_lines(None, (), 1)[1] == "1 object label had no room"


def test_a_lost_robot_without_an_estimate_is_drawn_too(tmp_path: Path) -> None:
    lost = LostRobot(Spot(2, 1), None)
    draw_map(_two_places(), tmp_path / "map.png", title="", lost=lost)
    assert (tmp_path / "map.png").stat().st_size > 10_000


@pytest.mark.parametrize("suffix", ["png", "svg", "pdf"])
def test_a_class_may_be_called_anything(tmp_path: Path, suffix: str) -> None:
    """``$…$`` is not parsed as a formula, and letters that the font lacks raise no warning."""
    view, out = _two_places(), tmp_path / f"map.{suffix}"
    names = "$\\frac$", "a $x$ $b", "\u2615 \U0001f916", "\u65e5\u672c"
    _add_objects(view, names)
    draw_map(view, out, title="lo$g$")
    assert out.stat().st_size > 10_000
    assert suffix != "svg" or ">lo$g$</text>" in out.read_text("utf-8")


@pytest.mark.parametrize("suffix", ["png", "svg", "pdf"])
def test_the_same_map_gives_the_same_bytes(tmp_path: Path, suffix: str) -> None:
    one, two = tmp_path / f"one.{suffix}", tmp_path / "sub" / f"two.{suffix}"
    draw_map(_two_places(), one, title="t")
    draw_map(_two_places(), two, title="t")
    assert one.read_bytes() == two.read_bytes()


def test_keyframes_without_a_pose_are_left_out(tmp_path: Path) -> None:
    view = _two_places()
    view.apply(d.KeyframeAdded(10, 10, 0, "run", 10, 10.0, None))
    with_lost, without = tmp_path / "with.svg", tmp_path / "without.svg"
    draw_map(view, with_lost, title="t")
    draw_map(_two_places(), without, title="t")
    changed = with_lost.read_text("utf-8").replace("11 keyframes", "10 keyframes")
    assert changed == without.read_text("utf-8")


def test_a_png_is_large_enough_to_read(tmp_path: Path) -> None:
    out = tmp_path / "map.PNG"
    draw_map(_two_places(), out, title="t", plan=plan_of(build_house(7)))
    width, height = struct.unpack(">II", out.read_bytes()[16:24])
    assert width >= 1200
    assert height >= 800


def test_an_empty_map_is_a_picture_too(tmp_path: Path) -> None:
    texts = _texts(compose(MapView(Settings()), "nothing yet", HousePlan()))
    assert any("0 places" in text for text in texts)
    draw_map(MapView(Settings()), tmp_path / "map.png", title="nothing yet")
    assert (tmp_path / "map.png").stat().st_size > 1_000


@pytest.mark.parametrize("name", ["map.jpg", "map", "map.txt"])
def test_another_suffix_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(MisuseError, match=r"a picture is \.png, \.svg or \.pdf"):
        draw_map(MapView(Settings()), tmp_path / name, title="")


def test_an_unwritable_place_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(MisuseError, match="cannot be written"):
        draw_map(MapView(Settings()), tmp_path / "file" / "map.png", title="")


def test_places_get_colours_of_their_own() -> None:
    colours = [place_colour(index) for index in range(60)]
    assert len(set(colours)) == 60
    assert all(re.fullmatch("#[0-9a-f]{6}", colour) for colour in colours)
