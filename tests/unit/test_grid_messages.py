"""nav_msgs/OccupancyGrid as JSON: cells, origin and yaw; and what is refused."""

import json
import math
from typing import Any

import numpy as np
import pytest

from eventsrc.envelope.grid_messages import is_grid_message, read_grid_message
from eventsrc.envelope.occupancy_map import InvalidMap
from tests.support.envelopes import envelope, payload
from tests.support.maps import drawn_map, grid_message

MAP = drawn_map("#.? .##", 0.25, (1.5, -2.0, -0.7))


def _read(document: Any) -> str:
    with pytest.raises(InvalidMap) as caught:
        read_grid_message(payload(document), "tb/map")
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_message_is_the_map_that_it_was_made_of() -> None:
    read = read_grid_message(payload(grid_message(MAP)), "tb/map")
    assert np.array_equal(read.cells, MAP.cells)
    assert read.cells.dtype == np.uint8
    assert (read.map_id, read.resolution, read.source) == (None, 0.25, "tb/map")
    assert read.origin[:2] == (1.5, -2.0)
    assert math.isclose(read.origin[2], -0.7)


def test_cells_keep_how_likely_they_are_occupied() -> None:
    document = grid_message(MAP)
    document["data"] = [0, 1, 64, 65, 100, -1]
    read = read_grid_message(payload(document), "k")
    assert read.cells.tolist() == [[0, 1, 64], [65, 100, 255]]


def test_the_first_value_is_the_cell_at_the_origin() -> None:
    document = grid_message(MAP, width=3, height=2)
    document["data"] = [1, 2, 3, 4, 5, 6]
    assert read_grid_message(payload(document), "k").cells[0].tolist() == [1, 2, 3]


def test_an_orientation_that_is_not_set_is_no_turn() -> None:
    document = grid_message(MAP)
    document["info"]["origin"]["orientation"] = {"x": 0, "y": 0, "z": 0, "w": 0}
    assert read_grid_message(payload(document), "k").origin[2] == 0.0
    del document["info"]["origin"]
    assert read_grid_message(payload(document), "k").origin == (0.0, 0.0, 0.0)


def test_a_message_may_name_its_floor() -> None:
    assert read_grid_message(payload(grid_message(MAP)), "k").floor is None
    assert read_grid_message(payload({**grid_message(MAP), "floor": 2}), "k").floor == "2"
    assert read_grid_message(payload({**grid_message(MAP), "floor": "attic"}), "k").floor == "attic"
    assert "Expected `int | str | null`" in _read({**grid_message(MAP), "floor": [2]})


def test_what_means_to_be_a_grid_is_told_from_an_envelope() -> None:
    assert is_grid_message(payload(grid_message(MAP)))
    assert is_grid_message(b"\n " + payload(grid_message(MAP)))
    assert not is_grid_message(payload(envelope(1)))
    assert not is_grid_message(b"junk")
    assert not is_grid_message(b'["info", "resolution", "data"]')


def test_what_is_wrong_is_named() -> None:
    good = grid_message(MAP)
    assert "5 values, where 3 × 2 cells take 6" in _read({**good, "data": [0] * 5})
    assert "7 values, where 3 × 2 cells take 6" in _read({**good, "data": [0] * 7})
    assert "more than the 6 values of 3 × 2" in _read({**good, "data": [0] * 700})
    assert "-1 is unknown, else 0 to 100" in _read({**good, "data": [0, 0, 0, 0, 0, 101]})
    assert "-1 is unknown, else 0 to 100" in _read({**good, "data": [0, 0, 0, 0, 0, -2]})
    assert "-1 is unknown, else 0 to 100" in _read({**good, "data": [0, 0, 0, 0, 0, 0.5]})
    assert "-1 is unknown, else 0 to 100" in _read({**good, "data": "AAAA"})
    assert "no nav_msgs/OccupancyGrid: Object missing required field" in _read({"info": {}})
    assert "Expected `float`" in _read(grid_message(MAP, resolution="0.1"))
    assert "it has 0 × 2 cells; a side has 1 to 10,000" in _read(grid_message(MAP, width=0))
    assert "a side has 1 to 10,000" in _read(grid_message(MAP, width=4_000_000_000))
    assert "Expected `int` >= 0" in _read(grid_message(MAP, height=-1))
    tilted = grid_message(MAP)
    tilted["info"]["origin"]["orientation"] = {"x": 0.7, "y": 0.0, "z": 0.0, "w": 0.7}
    assert "(0.7, 0, 0, 0.7) is no turn about the vertical" in _read(tilted)
    long = grid_message(MAP)
    long["info"]["origin"]["orientation"] = {"w": 2.0}
    assert "is no turn about the vertical" in _read(long)


def test_nan_is_no_json_and_is_refused() -> None:
    text = json.dumps(grid_message(MAP, resolution=math.nan)).encode()
    with pytest.raises(InvalidMap, match="no nav_msgs/OccupancyGrid: JSON is malformed"):
        read_grid_message(text, "k")


def test_deep_nesting_is_refused() -> None:
    text = b'{"info": ' + b"[" * 100_000 + b', "resolution": "data"'
    with pytest.raises(InvalidMap):
        read_grid_message(text, "k")
