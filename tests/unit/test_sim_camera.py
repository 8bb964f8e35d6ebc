"""Drawn pictures against a ray that is followed step by step, and the files they are written to."""

import itertools
import json
import math
import random
import threading
from pathlib import Path

import numpy as np
import pytest

from eventsrc.adapters.detector.vision import decode
from eventsrc.adapters.sim import build_house
from eventsrc.adapters.sim.detector import (
    CAMERA_HEIGHT_M,
    FOCAL_PX,
    HEIGHT_PX,
    WIDTH_PX,
    visible_objects,
)
from eventsrc.adapters.sim.drive import TruePose, drive
from eventsrc.adapters.sim.house import House
from eventsrc.adapters.sim.simulation import plan_tour
from eventsrc.base.errors import MisuseError
from tests.support.drawn_pictures import (
    Camera,
    CameraPicture,
    camera_pictures,
    thing_colours,
    write_pictures,
)
from tests.support.thorough import mostly_slow

STEP_M = 0.004


@pytest.fixture(scope="module")
def house() -> House:
    return build_house(7)


@pytest.fixture(scope="module")
def poses(house: House) -> list[TruePose]:
    return list(itertools.islice(drive(house.grid, plan_tour(house, "a")), 0, 1500, 30))


def _followed(house: House, pose: TruePose, u: float, v: float) -> str | None:
    """The thing that the ray of a pixel meets first, None where it meets wall, floor or ceiling."""
    left, up = (WIDTH_PX / 2 - u) / FOCAL_PX, (HEIGHT_PX / 2 - v) / FOCAL_PX
    cos, sin = math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
    ahead = np.arange(0.06, 12.0, STEP_M)
    x = pose.x + ahead * (cos - sin * left)
    y = pose.y + ahead * (sin + cos * left)
    z = CAMERA_HEIGHT_M + ahead * up
    first, name = len(ahead), None
    for thing in house.things:
        rect, model = thing.footprint, thing.model
        inside = (x >= rect.x0) & (x <= rect.x1) & (y >= rect.y0) & (y <= rect.y1)
        inside &= (z >= model.base_m) & (z < model.base_m + model.height_m)
        if inside.any() and int(inside.argmax()) < first:
            first, name = int(inside.argmax()), thing.instance
    if name is None:
        return None
    return None if house.walls.block((pose.x, pose.y), (x[first], y[first])) else name


def test_pixels_show_what_their_rays_meet(house: House, poses: list[TruePose]) -> None:
    camera = Camera(house)
    names = {colour: name for name, colour in camera.colours.items()}
    rng = random.Random(5)
    met = compared = 0
    for pose in rng.sample(poses, 12):
        pixels = camera.draw(pose).pixels
        for _ in range(25):
            u, v = rng.randrange(3, WIDTH_PX - 3), rng.randrange(3, HEIGHT_PX - 3)
            around = pixels[v - 2 : v + 3, u - 2 : u + 3].reshape(-1, 3)
            if (around != around[0]).any():
                continue  # at an edge a step more or less decides
            blue, green, red = pixels[v, u].tolist()
            shown = names.get((red, green, blue))
            assert shown == _followed(house, pose, u + 0.5, v + 0.5), (pose, u, v)
            compared += 1
            met += shown is not None
    assert compared > 200
    assert met > 20


def test_boxes_are_around_the_pixels_that_show_a_thing(house: House, poses: list[TruePose]) -> None:
    camera = Camera(house)
    for pose in poses[::5]:
        view = camera.draw(pose)
        for shown in view.shown:
            mine = (view.pixels[:, :, ::-1] == camera.colours[shown.instance]).all(axis=2)
            rows, columns = np.nonzero(mine)
            box = (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
            assert shown.box == box
            assert shown.pixels == mine.sum()


def test_it_sees_what_the_simulated_detector_sees(house: House, poses: list[TruePose]) -> None:
    """The detector looks through furniture, so what it sees and the camera does not is hidden."""
    camera = Camera(house)
    seen = hidden = 0
    for pose in poses:
        shown = {each.instance: each.box for each in camera.draw(pose).shown}
        for visible in visible_objects(house, pose):
            box = shown.get(visible.thing.instance)
            seen += 1
            if box is None:
                hidden += 1
                continue
            assert all(low - 2 <= edge for low, edge in zip(visible.box[:2], box[:2], strict=True))
    assert seen > 40
    assert hidden <= 0.15 * seen


@pytest.mark.parametrize("seed", mostly_slow([7, 12]))
def test_colours_differ_and_those_of_a_class_by_hue(seed: int) -> None:
    house = build_house(seed)
    colours = thing_colours(house)
    assert len(set(colours.values())) == len(house.things)
    for one, other in itertools.combinations(colours.values(), 2):
        assert max(abs(a - b) for a, b in zip(one, other, strict=True)) >= 63
    assert all(max(c) - min(c) >= 128 for c in colours.values())
    assert colours == thing_colours(build_house(seed))


@pytest.fixture(scope="module")
def few() -> list[CameraPicture]:
    return list(itertools.islice(camera_pictures(per_s=2.0), 4))


def test_a_folder_of_pictures(tmp_path: Path, few: list[CameraPicture]) -> None:
    pictures = few
    assert write_pictures(iter(pictures), tmp_path / "new" / "one", threading.Event()) == 4
    folder = tmp_path / "new" / "one"
    names = sorted(path.name for path in folder.glob("*.jpg"))
    assert names == [f"{picture.stamp_s:.3f}.jpg" for picture in pictures]
    assert [p.stamp_s - pictures[0].stamp_s for p in pictures] == pytest.approx([0, 0.5, 1, 1.5])
    assert decode((folder / names[0]).read_bytes()).shape == (HEIGHT_PX, WIDTH_PX, 3)
    head, *rows = (folder / "poses.csv").read_text().splitlines()
    assert head == "stamp,x,y,yaw"
    assert [float(row.split(",")[0]) for row in rows] == [p.stamp_s for p in pictures]
    truth = [json.loads(line) for line in (folder / "truth.jsonl").read_text().splitlines()]
    assert [t["stamp"] for t in truth] == [p.stamp_s for p in pictures]
    with pytest.raises(MisuseError, match="not empty"):
        write_pictures(iter(pictures), folder, threading.Event())
    with pytest.raises(MisuseError, match="cannot be written"):
        write_pictures(iter(pictures), folder / "poses.csv", threading.Event())
    stop = threading.Event()
    stop.set()
    assert write_pictures(iter(pictures), tmp_path / "stopped", stop) == 0


def test_poses_are_off_by_what_a_localisation_is_off(
    house: House, few: list[CameraPicture]
) -> None:
    driven = itertools.islice(drive(house.grid, plan_tour(house, "a")), 100)
    true = {round(p.time_s, 3): p for p in driven}
    for picture in few:
        at = true[round(picture.time_s, 3)]
        assert 0 < math.dist((picture.pose["x"], picture.pose["y"]), (at.x, at.y)) < 0.1
