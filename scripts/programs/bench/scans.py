"""Walls of range scans against the truth, and what folding them costs: ``scripts/bench_scans``.

scripts/bench_scans [--half develop|validate] [--world W…] [--profile P…] [--limit N] [--seed N]
    [--set NAME=VALUE…] [--rounds N] [--worlds DIR] [--cache DIR]

A lidar of 360 beams and 12 m, 1 cm noise, measures the walls of the building's layout from where
the robot truly was; the fold has the pose that the robot states. V is that of ``scripts/bench_truth
--places``. A fold's cost is the least processor time of some rounds, the two sides by turns.
"""

import argparse
import json
import math
import sys
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import msgspec
import numpy as np
import pybase64
from numpy.typing import NDArray

from eventsrc.envelope.ingest import Accepted
from eventsrc.envelope.model import NO_RETURN_MM, StatedScan
from projections.fold.settings import Settings

from .truth.folding import fold_timed
from .truth.places import LEAST_WALLED, score_places
from .truth.tables import number
from .truth.walls import Walls, world_walls
from .truth.worlds import (
    CACHE,
    LIMIT,
    SEED,
    WORLDS,
    Case,
    NoWorldsError,
    case_folder,
    load_generator,
    pairs,
    read_case,
)

BEAMS, REACH_M, NOISE_M = 360, 12.0, 0.01


@dataclass(frozen=True, slots=True)
class ScansRow:
    """One robot in one building."""

    name: str
    keyframes: int
    none: float
    scanned: float
    true_map: float
    none_s: float
    scanned_s: float

    @property
    def gap(self) -> float:
        """How far V by scans is below V by the true map."""
        return self.true_map - self.scanned

    @property
    def cost(self) -> float:
        """The fold with scans, in folds without."""
        return self.scanned_s / self.none_s


def main() -> None:
    """Run as the command line says."""
    options = _options()
    try:
        generator = load_generator(options.worlds)
        rows = []
        for profile, world in pairs(generator, options.half, options.world, options.profile):
            walls = world_walls(generator, world)
            if not options.world and walls.walled < LEAST_WALLED:
                continue
            print(f"\r{profile} {world} …\033[K", end="", file=sys.stderr, flush=True)
            case, scans = _scanned_case(generator, profile, world, options)
            settings = Settings(places="rooms", fusion="evidence", camera=case.camera_settings)
            settings = settings.with_assignments(options.set)
            rows.append(scans_row(case, scans, walls, settings, options.rounds))
    except NoWorldsError as error:
        sys.exit(str(error))
    print("\r\033[K", end="", file=sys.stderr, flush=True)
    print(f"{options.half} half, {len(rows)} of world × profile, at most {options.limit} keyframes")
    print(scans_table(rows))


def scans_row(
    case: Case, scans: Sequence[StatedScan], walls: Walls, settings: Settings, rounds: int
) -> ScansRow:
    """Fold a case without walls, with scans and with the true map."""
    events = [
        Accepted(msgspec.structs.replace(each.envelope, scan=scan), each.det_ids, each.vectors)
        for each, scan in zip(case.events, scans, strict=True)
    ]
    seconds: tuple[list[float], list[float]] = ([], [])
    for _ in range(rounds):
        none, spent = fold_timed(case.events, settings)
        seconds[0].append(spent)
        scanned, spent = fold_timed(events, settings)
        seconds[1].append(spent)
    true_map, _ = fold_timed(case.events, settings, walls.map)
    v = (score_places(v, case.truth, {}, 0, 0.0).v_measure for v in (none, scanned, true_map))
    return ScansRow(case.name, len(events), *v, *map(min, seconds))


def cast(
    segments: NDArray[np.float64], pose: Sequence[float], noise: np.random.Generator
) -> StatedScan:
    """The scan that a lidar takes at a pose between walls, which are rows of x1, y1, x2, y2."""
    step = 2 * math.pi / BEAMS
    angles = np.arange(BEAMS) * step
    x, y, yaw = pose
    ux, uy = np.cos(yaw + angles)[:, None], np.sin(yaw + angles)[:, None]
    ax, ay = segments[:, 0] - x, segments[:, 1] - y
    dx, dy = segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        across = ux * dy - uy * dx
        far = (ax * dy - ay * dx) / across
        along = (ax * uy - ay * ux) / across
    met = (far > 0) & (along >= 0) & (along <= 1)
    least = np.where(met, far, np.inf).min(axis=1)
    least = np.where(least < REACH_M, least + noise.normal(0, NOISE_M, BEAMS), np.inf)
    mm = np.where(np.isfinite(least), np.rint(1000 * np.clip(least, 0.001, 60)), NO_RETURN_MM)
    encoded = pybase64.b64encode(mm.astype("<u2").tobytes()).decode()
    return StatedScan(0.0, step, encoded, REACH_M)


def scans_table(rows: Sequence[ScansRow]) -> str:
    """A line for each robot in a building, the farthest below the true map last, then means."""
    heads = "kf", "V none", "V scans", "V map", "gap", "s none", "s scans", "× cost"
    lines = [_line("profile world", heads)]
    for row in sorted(rows, key=lambda row: row.gap):
        scores = row.none, row.scanned, row.true_map, row.gap
        cells = [str(row.keyframes), *(number(each, 3) for each in scores)]
        cells += [number(each, 2) for each in (row.none_s, row.scanned_s, row.cost)]
        lines.append(_line(row.name, cells))
    if len(rows) > 1:
        means = ([row.none, row.scanned, row.true_map, row.gap] for row in rows)
        cells = [number(sum(each) / len(rows), 3) for each in zip(*means, strict=True)]
        spent = sum(row.none_s for row in rows), sum(row.scanned_s for row in rows)
        cells += [number(each, 2) for each in (*spent, spent[1] / spent[0])]
        lines.append(_line("all", [str(sum(row.keyframes for row in rows)), *cells]))
        worst = max(rows, key=lambda row: row.cost)
        lines.append(f"dearest: {worst.name} × {number(worst.cost, 2)}")
    return "\n".join(lines)


def _line(name: str, cells: Sequence[str]) -> str:
    return name.ljust(26) + " ".join(cell.rjust(8) for cell in cells)


def _scanned_case(
    generator: ModuleType, profile: str, world: str, options: argparse.Namespace
) -> tuple[Case, list[StatedScan]]:
    folder = case_folder(generator, profile, world, 0.0, options.limit, options.seed, options.cache)
    case, layout = read_case(folder, profile, world), options.worlds / "layouts" / f"{world}.json"
    segments = np.array(json.loads(layout.read_text())["walls"], float)
    noise = np.random.default_rng(zlib.crc32(case.name.encode()))
    kept = folder / "true-poses.json"
    if not kept.exists():
        kept.write_text(json.dumps(_true_poses(generator, profile, world, options)))
    poses = json.loads(kept.read_text())
    return case, [cast(segments, pose, noise) for pose in poses]


def _true_poses(
    generator: ModuleType, profile: str, world: str, options: argparse.Namespace
) -> list[Any]:
    """Where the robot was at each keyframe; the generator draws the same run again."""
    robot, building = generator.PROFILES[profile], generator.World(world)
    seed, limit = options.seed, options.limit
    region = generator.region_of(building, robot, generator.crc(profile, seed), limit)
    about = robot, profile, building.objects, seed, region, limit
    return [
        extra["true"]
        for run in robot["runs"]
        for _, _, extra in generator.simulate(building, *about[:2], run, *about[2:])
    ]


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="scripts/bench_scans", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument("--half", choices=("develop", "validate"), default="develop")
    parser.add_argument("--world", nargs="+", default=[], metavar="W")
    parser.add_argument("--profile", nargs="+", default=[], metavar="P")
    parser.add_argument("--limit", type=int, default=LIMIT, help=f"most keyframes a run ({LIMIT})")
    parser.add_argument("--seed", type=int, default=SEED, help=f"of the generator ({SEED})")
    parser.add_argument("--rounds", type=int, default=2, help="folds of which the quickest counts")
    parser.add_argument("--set", nargs="+", default=[], metavar="NAME=VALUE", help="settings")
    parser.add_argument("--worlds", type=Path, default=WORLDS, help="folder of make_worlds.py")
    parser.add_argument("--cache", type=Path, default=CACHE, help="where generated runs are kept")
    return parser.parse_args()


if __name__ == "__main__":
    main()
