"""The line that names a setting where everything is one place, or nothing is in any."""

import pytest

from projections.fold.settings import Settings
from projections.map.state_output import places_advice

PAGE, ROOMS = Settings(), Settings(places="rooms")


def advice(poses: int, noise: int, places: int, settings: Settings = PAGE) -> str | None:
    return places_advice({"poses": poses, "noise": noise, "places": places}, settings)


@pytest.mark.parametrize("settings", [PAGE, ROOMS])
@pytest.mark.parametrize(
    ("poses", "noise", "places"), [(0, 0, 0), (19, 0, 1), (19, 19, 0), (100, 0, 2), (100, 79, 3)]
)
def test_no_advice_for_a_usual_map(poses: int, noise: int, places: int, settings: Settings) -> None:
    assert advice(poses, noise, places, settings) is None


def test_everything_in_one_place() -> None:
    assert advice(1234, 0, 1) == (
        "all 1,234 keyframes with a pose are in one place; if that is more than one room,"
        " --preset full tells them apart"
    )
    assert advice(20, 3, 1) == (
        "all 20 keyframes with a pose but 3 are in one place; if that is more than one room,"
        " --preset full tells them apart"
    )


def test_everything_in_one_place_under_rooms() -> None:
    told = advice(50, 0, 1, Settings.model_validate({"places": "rooms", "rooms": {"drive_m": 3.5}}))
    assert told == (
        "all 50 keyframes with a pose are in one place; if that is more than one room, a smaller"
        " rooms.drive_m than 3.5 tells them apart"
    )


@pytest.mark.parametrize(("noise", "places"), [(80, 1), (80, 2), (100, 0)])
def test_hardly_anything_in_a_place(noise: int, places: int) -> None:
    assert advice(100, noise, places) == (
        f"{noise} of 100 keyframes with a pose are in no place; --preset full puts each into one"
    )
