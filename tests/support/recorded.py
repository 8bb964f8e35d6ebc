"""Questions to generated maps whose answers are recorded, so that a faster ranking gives the same.

`recorded_answers.json` beside this file has the answers of the ranking as it was before it computed
all crops of a question at once. When the posterior is changed on purpose, record them anew:

    python -m tests.support.recorded
"""

import itertools
import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from projections.localize.relocalize import Answer, MapCandidates, Question, QuestionView, rank
from tests.support.buildings import Building, Keyframe, drive
from tests.support.scenes import RoomMap, Scene, Thing, around, crops_of, movement

FILE = Path(__file__).with_name("recorded_answers.json")


def questions() -> Iterator[tuple[str, Question, MapCandidates]]:
    """Each with a name: of a building whose landmarks are triangulated, and of scenes with
    estimates."""
    yield from _of_a_building()
    yield from _of_scenes()


def _of_a_building() -> Iterator[tuple[str, Question, MapCandidates]]:
    building = Building(41, things=40)
    mapped = RoomMap(drive(building, "recorded-a", 41, 200))
    run = [k for k in drive(building, "recorded-b", 141, 160) if len(k.instances) >= 3]
    for number, keyframe in enumerate(run[:24]):
        crops = crops_of(keyframe, boxes=number % 6 != 5)[: 1 + number % 4]
        yield f"building {number}", Question.of(tuple(crops)), mapped.search(crops)
    for number in range(6):
        seen = run[3 * number : 3 * number + 1 + number % 3 + 1]
        moved = [(0.0, 0.0, 0.0)]
        moved += [movement(_pose(a), _pose(b)) for a, b in itertools.pairwise(seen)]
        views = tuple(
            QuestionView(*step, tuple(crops_of(keyframe)[:2]))
            for step, keyframe in zip(moved, seen, strict=True)
        )
        question = Question(views)
        yield f"views {number}", question, mapped.search(question.crops)


def _pose(keyframe: Keyframe) -> tuple[float, float, float]:
    at = keyframe.accepted.envelope
    return at.map_x or 0.0, at.map_y or 0.0, at.map_yaw or 0.0


def _of_scenes() -> Iterator[tuple[str, Question, MapCandidates]]:
    for seed in range(12):
        rng = np.random.default_rng(seed)
        wide = 3.0 if seed % 3 else 40.0
        spots = rng.uniform(-wide, wide, (14 if seed % 3 == 0 else 5, 2))
        things = [Thing(float(x), float(y), float(rng.uniform(0.6, 1.6))) for x, y in spots]
        # no two alike, so that no tie is left to rounding
        shifts = rng.normal(0.0, 0.1, (len(things) * 6, 3))
        circles = [pose for thing in things for pose in around(thing, 6, 1.8)]
        poses = [
            (x + dx, y + dy, yaw + turn)
            for (x, y, yaw), (dx, dy, turn) in zip(circles, shifts.tolist(), strict=True)
        ]
        scene = Scene(things, poses, has_estimates=seed % 2 == 0)
        at = poses[seed]
        at = (at[0] + 0.13, at[1] - 0.07, at[2] + 0.11)
        question, candidates = scene.ask([(at, scene.in_view(at)[:3])], noise=0.03)
        yield f"scene {seed}", question, candidates
        (view,) = question.views
        crops = (replace(view.crops[0], is_text=True), *view.crops[1:])
        yield f"text {seed}", Question((replace(view, crops=crops),)), candidates


def numbers(answer: Answer) -> dict[str, Any]:
    """What is recorded of an answer."""
    pose = answer.pose
    assert pose is not None
    assert answer.hypotheses is not None
    return {
        "pose": [pose.x, pose.y, math.nan if pose.yaw is None else pose.yaw, pose.spread_m],
        "probabilities": [answer.known, answer.confidence],
        "places": [[place.place_id, place.score] for place in answer.places],
        "hypotheses": [
            len(answer.hypotheses.weights),
            *answer.hypotheses.poses[0].tolist(),
            *answer.hypotheses.weights[:5].tolist(),
        ],
    }


def main() -> None:
    """Record the answers of the ranking as it is now."""
    found = {
        name: numbers(rank(question, candidates, top=5))
        for name, question, candidates in questions()
    }
    FILE.write_text(json.dumps(found, indent=0) + "\n", "utf-8")


if __name__ == "__main__":
    main()
