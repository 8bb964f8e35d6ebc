"""The occupancy map in a picture: where its walls come to lie, and that none is lost."""

import numpy as np
import pytest

from eventsrc.envelope.occupancy_map import OccupancyMap
from projections.adapters.drawing import HousePlan
from projections.adapters.drawing.base_layers import wall_spots
from projections.adapters.drawing.map_picture import compose
from projections.fold.deltas import MapGiven
from projections.fold.settings import Settings
from projections.map.view import MapView
from tests.support.envelopes import envelope
from tests.support.folds import fold
from tests.support.maps import drawn_map

pytestmark = pytest.mark.seconds


def _view(given: OccupancyMap, *spots: tuple[float, float]) -> MapView:
    view = fold([envelope(k, x, y) for k, (x, y) in enumerate(spots)]).view
    view.maps[None] = MapGiven(0, given)
    return view


def _drawn_walls(view: MapView) -> tuple[np.ndarray, np.ndarray]:
    """Where the middles of the drawn wall cells lie, in metres, shape (n, 2); the area drawn."""
    sheet = compose(view, "t", HousePlan())
    _, walls = sheet.axes.get_images()
    alpha = np.asarray(walls.get_array())[..., 3]
    height, width = alpha.shape
    _, right, _, top = walls.get_extent()
    rows, columns = np.nonzero(alpha)
    middles = np.stack([(columns + 0.5) * right / width, (rows + 0.5) * top / height], axis=1)
    pixels = walls.get_transform().transform(middles)
    bounds = np.array([*sheet.axes.get_xlim(), *sheet.axes.get_ylim()])
    assert np.allclose(bounds[[0, 2, 1, 3]], sheet.bounds)
    return sheet.axes.transData.inverted().transform(pixels), bounds


@pytest.mark.parametrize("yaw", [0.0, 0.5, -2.0])
def test_walls_are_drawn_where_they_stand(yaw: float) -> None:
    given = drawn_map("####. #...? #..#.", 0.5, (3.0, -1.0, yaw))
    middle = (3.0 + np.cos(yaw) - np.sin(yaw), -1.0 + np.sin(yaw) + np.cos(yaw))
    found, _ = _drawn_walls(_view(given, middle))
    rows, columns = np.nonzero(given.cells == 100)
    u, v = (columns + 0.5) * 0.5, (rows + 0.5) * 0.5
    x, y = 3.0 + np.cos(yaw) * u - np.sin(yaw) * v, -1.0 + np.sin(yaw) * u + np.cos(yaw) * v
    expected = sorted(np.stack([x, y], axis=1).round(6).tolist())
    assert np.allclose(sorted(found.round(6).tolist()), expected, atol=1e-5)


def test_no_wall_is_lost_where_cells_become_fewer() -> None:
    cells = np.zeros((4000, 3000), np.uint8)
    cells[:, 1500] = 100
    given = OccupancyMap(None, 0.005, (0.0, 0.0, 0.0), "s", cells)
    found, _ = _drawn_walls(_view(given, (5.0, 5.0), (10.0, 15.0)))
    assert len(found) > 1000
    assert np.allclose(found[:, 0], 7.5, atol=0.02)


def test_the_picture_has_room_for_walls_near_the_drive_only() -> None:
    cells = np.full((400, 400), 100, np.uint8)
    given = OccupancyMap(None, 0.5, (-100.0, -100.0, 0.0), "s", cells)
    view = _view(given, (0.0, 0.0), (4.0, 0.0))
    spots = np.array(wall_spots(view))
    assert (spots[0] >= (-1.5, -1.5)).all()
    assert (spots[1] <= (5.5, 1.5)).all()
    _, bounds = _drawn_walls(view)
    assert bounds[1] - bounds[0] < 10


def test_a_map_away_from_the_drive_or_without_one_is_no_trouble() -> None:
    given = drawn_map("###", 0.5, (500.0, 500.0, 0.0))
    assert wall_spots(_view(given, (0.0, 0.0))) == []
    assert compose(_view(given, (0.0, 0.0)), "t", HousePlan()).axes.get_images() == []
    alone = MapView(Settings())
    alone.maps[None] = MapGiven(0, given)
    found, _ = _drawn_walls(alone)
    assert len(found) == 3
    alone.maps[None] = MapGiven(0, drawn_map("..", 0.5))
    compose(alone, "t", HousePlan())
