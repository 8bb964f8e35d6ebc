"""Lost robots: ``scripts/bench_truth --lost``. A robot wakes somewhere, turns once on the spot in
20 keyframes, and should be told where it is: in the building of the map, and in another one never.

It wakes at spots within 1.5 m of the first run's drive, the same number in the other building.
Movement between keyframes is by the poses that the profile reports.
"""

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

from eventsrc.base.text import table
from eventsrc.envelope.ingest import Accepted, ingest_all
from projections.localize.relocalize import ExactIndex, rank
from projections.localize.relocalize.waking_robot import MOST_KEYFRAMES, WakingRobot

from .localising import first_run, make_map
from .worlds import SEED, Case

TRIALS = 12
NEAR_DRIVE_M = 1.5
WITHIN_M, WITHIN_RAD = 1.0, math.radians(20.0)

Pose = tuple[float, float, float]
Turn = list[tuple[Accepted, Pose]]
"""The keyframes of one turn, each with the robot's true pose."""


@dataclass(frozen=True, slots=True)
class LostRow:
    """A robot in a building: of ``trials`` how many saw something in two keyframes or more, were
    told a pose, and a right one; of ``strangers`` how many were told one. ``keyframes`` and
    ``errors_m`` are of those that were told."""

    name: str
    trials: int
    saw: int
    told: int
    right: int
    strangers: int
    strangers_told: int
    keyframes: list[int]
    errors_m: list[float]


def lost_row(
    generator: ModuleType,
    case: Case,
    stranger: str,
    limit: int,
    seed: int = SEED,
    trials: int = TRIALS,
) -> LostRow:
    """One robot of a case, whose name is ``PROFILE WORLD`` and whose runs were generated with
    ``seed``; ``stranger`` is another world."""
    profile, _, world = case.name.partition(" ")
    index = ExactIndex(make_map(case, "evidence"))
    drive = [(each.envelope.map_x or 0.0, each.envelope.map_y or 0.0) for each in first_run(case)]
    own = [*turns(generator, world, profile, limit, drive, trials, seed)]
    others = [*turns(generator, stranger, profile, limit, [], len(own), seed)]
    told = [found for turn in own if (found := _told(turn, index, case)) is not None]
    return LostRow(
        case.name,
        len(own),
        sum(sum(bool(each.vectors) for each, _ in turn) > 1 for turn in own),
        len(told),
        sum(metres <= WITHIN_M and radians <= WITHIN_RAD for _, metres, radians in told),
        len(others),
        sum(_told(turn, index, case) is not None for turn in others),
        [keyframes for keyframes, *_ in told],
        [metres for _, metres, _ in told],
    )


def turns(
    generator: ModuleType,
    world: str,
    profile: str,
    limit: int,
    drive: Sequence[tuple[float, float]],
    trials: int,
    seed: int = SEED,
) -> Iterator[Turn]:
    """Turns at spots near ``drive``, anywhere if it is empty, by the generator's camera, detector
    and pose errors."""
    building, how = generator.World(world), generator.PROFILES[profile]
    region = generator.region_of(building, how, generator.crc(profile, seed), limit)
    chance = generator.np.random.default_rng(generator.crc(world, profile, "lost", seed))
    stops = [cell for _, cell in generator.stops_of(building, 1.5, chance, region)]
    spots = [(float(building.cx[cell]), float(building.cy[cell])) for cell in stops]
    chance.shuffle(spots)
    near = [
        (x, y)
        for x, y in spots
        if not drive or min(math.dist((x, y), each) for each in drive) <= NEAR_DRIVE_M
    ][:trials]

    def tour(*_: Any) -> Iterator[tuple[str, float, float, float]]:
        for x, y in near:
            start, way = chance.uniform(-math.pi, math.pi), 1 if chance.random() < 0.5 else -1
            for step in range(MOST_KEYFRAMES):
                yaw = start + way * step * math.tau / MOST_KEYFRAMES
                yield "spin", x, y, generator.wrap(yaw)

    usual, generator.tour = generator.tour, tour
    try:
        spinning = {**how, "tour": "spin"}
        count = MOST_KEYFRAMES * len(near)
        made = generator.simulate(
            building, spinning, profile, "b", building.objects, seed + 1, region, count
        )
        rows = [*made]
    finally:
        generator.tour = usual
    seen = ingest_all([json.dumps(envelope).encode() for envelope, *_ in rows])
    keyframes = [each for each in seen if isinstance(each, Accepted)]
    poses = [extra["true"] for *_, extra in rows]
    for first in range(0, len(rows), MOST_KEYFRAMES):
        last = first + MOST_KEYFRAMES
        yield [*zip(keyframes[first:last], poses[first:last], strict=True)]


def _told(turn: Turn, index: ExactIndex, case: Case) -> tuple[int, float, float] | None:
    """Keyframes until the initial pose is published, and its errors in metres and radians."""
    robot = WakingRobot()
    for number, (keyframe, (x, y, yaw)) in enumerate(turn, start=1):
        question = robot.see(keyframe)
        if question is None:
            continue
        answer = rank(question, index.search(question.crops), camera=case.camera)
        sure = robot.judge(answer)
        if sure is not None:
            turned = abs(math.remainder(sure.yaw - yaw, math.tau))
            return number, math.dist((sure.x, sure.y), (x, y)), turned
    return None


def lost_table(rows: Sequence[LostRow]) -> str:
    """A line for each robot, and all of them."""
    header = ["robot", "turns", "saw", "told", "right", "keyframes", "p50 m", "elsewhere", "told "]
    lines = [_line(row) for row in rows]
    total = LostRow(
        "all",
        *(sum(getattr(row, name) for row in rows) for name in ("trials", "saw", "told", "right")),
        *(sum(getattr(row, name) for row in rows) for name in ("strangers", "strangers_told")),
        [count for row in rows for count in row.keyframes],
        [metres for row in rows for metres in row.errors_m],
    )
    return table(header, [*lines, _line(total)], right=tuple(header[1:]))


def _line(row: LostRow) -> list[str]:
    counts = row.trials, row.saw, row.told, row.right
    middle = [_median(row.keyframes, "{:.0f}"), _median(row.errors_m, "{:.2f}")]
    return [row.name, *map(str, counts), *middle, str(row.strangers), str(row.strangers_told)]


def _median(values: Sequence[float], form: str) -> str:
    return form.format(sorted(values)[len(values) // 2]) if values else "none"
