"""A map with a part of the lost robot's own run beside another run, as a live tail makes it."""

import math
from functools import cache

import pytest

from projections.localize.relocalize import Answer, rank
from tests.support.buildings import Building, Keyframe, drive
from tests.support.scenes import RoomMap, crops_of
from tests.support.thorough import mostly_slow

SEEDS = (20, 21, 22)


@cache
def runs(seed: int) -> tuple[list[Keyframe], list[Keyframe]]:
    """An exploring run and the lost robot's own."""
    building = Building(seed, things=40)
    return (
        drive(building, f"m{seed}-a", seed, 250),
        drive(building, f"m{seed}-b", seed + 100, 160),
    )


def ask(mapped: list[Keyframe], asked: list[Keyframe]) -> list[tuple[float, Answer]]:
    """Errors in metres and answers of three-crop questions."""
    found, searched = [], RoomMap(mapped)
    for keyframe in asked:
        crops = crops_of(keyframe)[:3]
        if len(crops) == 3:
            answer = rank(crops, searched.search(crops))
            assert answer.pose is not None
            at = keyframe.accepted.envelope
            error = math.hypot(answer.pose.x - (at.map_x or 0), answer.pose.y - (at.map_y or 0))
            found.append((error, answer))
    assert len(found) > 10
    return found


@pytest.mark.parametrize("seed", mostly_slow(SEEDS))
def test_half_of_the_own_run_beside_another_does_no_harm(seed: int) -> None:
    explored, own = runs(seed)
    found = ask(explored + own[::2], own[1::2])
    assert sum(error <= 1.5 for error, _ in found) >= 0.9 * len(found)
    assert sum(answer.unknown for _, answer in found) <= 0.05 * len(found)


@pytest.mark.parametrize("seed", mostly_slow(SEEDS))
def test_the_very_crops_in_the_map_lead_to_where_they_were_seen(seed: int) -> None:
    """A confident answer to a crop that is in the map must be right."""
    explored, own = runs(seed)
    found = ask(explored + own, own)
    sure = [error for error, answer in found if answer.confidence >= 0.85]
    assert len(sure) >= 0.8 * len(found)
    assert max(sure) <= 1.5
