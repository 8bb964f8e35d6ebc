"""Which of the poses that saw a thing is its goal."""

import math

import numpy as np
import pytest

from eventsrc.base.errors import MisuseError
from eventsrc.envelope.model import DetId, KeyframeId, Offset, RunId
from eventsrc.envelope.occupancy_map import UNKNOWN, OccupancyMap
from projections.ask.goal_pose import GoalGround, GoalPose
from projections.fold.deltas import (
    KeyframeOrdinal,
    MapGiven,
    ObjectOrdinal,
    ObservationOrdinal,
    Pose,
    RunOrdinal,
)
from projections.fold.settings import Settings
from projections.map.records import (
    EstimatedPosition,
    KeyframeRecord,
    ObjectRecord,
    ObservationRecord,
)
from projections.map.view import MapView
from tests.support.envelopes import detection, envelope
from tests.support.folds import Folded

OFTEN = [(3.0 + 0.1 * step, 0.0) for step in range(4)]
"""Spots beside each other, with the thing at the origin."""


def goal_of(
    *runs: list[tuple[float, float]],
    other: tuple[float, float] | None = None,
    walls: OccupancyMap | None = None,
) -> GoalPose:
    """The goal of a thing at the origin that was seen from the spots of some runs; another thing
    may stand somewhere."""
    view = MapView(Settings(), keep_embeddings=False)
    if walls is not None:
        view.maps[None] = MapGiven(Offset(0), walls)
    thing = ObjectRecord(ObjectOrdinal(0), "o0", "oven", confirmed=True)
    for run, spots in enumerate(runs):
        for x, y in spots:
            number = len(view.keyframes)
            pose = Pose(round(x * 1e6), round(y * 1e6), math.atan2(-y, -x))
            view.keyframes.append(
                KeyframeRecord(
                    *(
                        KeyframeOrdinal(number),
                        Offset(number),
                        RunOrdinal(run),
                        RunId(f"run-{run}"),
                    ),
                    *(KeyframeId(number), float(number), pose, view.survivors),
                )
            )
            observation = ObservationOrdinal(len(view.observations))
            view.observations.append(
                ObservationRecord(
                    ordinal=observation,
                    keyframe=KeyframeOrdinal(number),
                    det_id=DetId(f"d{number}"),
                    class_name="oven",
                    confidence=1.0,
                    bbox=(0.0, 0.0, 9.0, 9.0),
                    embedding_model=None,
                    embedding=None,
                    embedding_crc=None,
                    foreign_space=False,
                    object=thing.ordinal,
                )
            )
            thing.observations.append(observation)
    thing.estimate = EstimatedPosition(0, 0, 1, 0, 1, 2)
    view.objects[thing.ordinal] = thing
    if other is not None:
        x_um, y_um = (round(each * 1e6) for each in other)
        stands = ObjectRecord(ObjectOrdinal(1), "o1", "chair", confirmed=True)
        stands.estimate = EstimatedPosition(x_um, y_um, 1, 0, 1, 2)
        view.objects[stands.ordinal] = stands
    return GoalGround(view).goal(view, thing)


def test_a_goal_is_where_the_thing_was_seen_most() -> None:
    once = (0.0, 3.1)
    goal = goal_of([once, *OFTEN])
    assert goal.y == 0.0
    assert goal_of([once]).y == 3.1
    assert goal.distance_m < 3.2  # the nearest of these to 2.5 m


def test_a_goal_is_on_the_ground_of_the_last_run() -> None:
    before, now = [(-x, y) for x, y in OFTEN], OFTEN
    assert goal_of(before, now).x > 0.0
    assert goal_of(now, before).x < 0.0


def test_a_goal_is_not_where_another_thing_stands() -> None:
    beside = [(-x - 0.3, y) for x, y in OFTEN]
    assert goal_of([*OFTEN, *beside]).x > 0.0
    assert goal_of([*OFTEN, *beside], other=(3.1, 0.0)).x < 0.0


def test_a_goal_on_ground_that_no_robot_drove_keeps_away_from_unknown_ground() -> None:
    cells = np.zeros((80, 80), np.uint8)
    cells[:, 44:] = UNKNOWN
    given = OccupancyMap("m", 0.1, (-4.0, -4.0, 0.0), "m", cells)
    goal = goal_of([(0.3, 0.0)], walls=given)
    assert goal.ground == "free"
    assert goal.x + 0.3 <= 0.4


def test_a_goal_is_on_a_floor_or_in_a_frame_from_which_the_thing_was_seen() -> None:
    """Not where a robot drove on another one, which the same coordinates do not tell."""
    cup = [detection("cup", [1.0, 0.0, 0.0], depth_m=0.3, bbox=(300, 180, 340, 220))]
    ways = [envelope(number, number / 2, 0.0, run_id="r") for number in range(8)]
    for apart in ({"floor": "upper"}, {"frame": "b"}):
        beside = envelope(0, 1.5, 0.3, run_id="s", detections=cup, **apart)
        view = (
            Folded.start(Settings(places="rooms", fusion="evidence")).extend([*ways, beside]).view
        )
        (thing,) = view.objects.values()
        with pytest.raises(MisuseError, match="no pose from which cup"):
            GoalGround(view).goal(view, thing)
