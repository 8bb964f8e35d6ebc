"""One table: Objects with fusion=page and by evidence, side by side, against the truth.

scripts/bench_truth [--half develop|validate] [--quick] [--world W…] [--profile P…]
    [--moved FRACTION] [--calibrated] [--no-embeddings] [--places [--walls] | --types | --bags |
    --ask | --align | --jumps]
    [--limit N] [--seed N] [--set NAME=VALUE…]
    [--worlds DIR] [--cache DIR] [--json FILE]
scripts/bench_truth --lost [--quick] …
scripts/bench_truth --localise [--every N] [--map page|evidence] [--brief] [--no-camera]
    [--session-shift F] [--jobs N] …

With --no-embeddings the detectors are bare ones; in the table of Objects page is then as if all
looked alike: the class and the radius decide.

With --localise another table: where the robot is, asked of the map of run a. With --lost: lost
robots that turn once, and after how many keyframes the initial pose is published.

A line for each robot (profile) in a building (world), runs a, b and c in one log; the worst last.
"""

import argparse
import dataclasses
import functools
import json
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from types import ModuleType

import numpy as np

from eventsrc.envelope.occupancy_map import OccupancyMap
from projections.fold.map_errors import SettingsError
from projections.fold.settings import Settings
from projections.map.view import MapView

from . import tables
from .aligning import AlignRow, JumpRow, align_rows, align_table, jump_rows, jump_table
from .asking import AskedRow, Building, asked_row, asked_table
from .bags import BagRow, bag_row, bags_table
from .calibrating import calibrated_settings, calibration_table
from .folding import fold_timed
from .localising import MAPS, LocaliseRow, localise, stranger_of
from .localising_table import localise_table
from .losing import LostRow, lost_row, lost_table
from .moving import score_moved
from .place_types import TypesRow, types_row, types_table
from .places import RULES, PlacesRow, places_row, places_table
from .scoring import score_objects
from .telling import ToldScores, score_told, told_table
from .walls import world_names, world_walls
from .worlds import (
    CACHE,
    LIMIT,
    QUICK_LIMIT,
    SEED,
    WORLDS,
    Case,
    NoWorldsError,
    as_if_alike,
    case_folder,
    house_case,
    load_generator,
    make_case,
    pairs,
)


def main() -> None:
    """Run as the command line says."""
    options = _options()
    try:
        generator = load_generator(options.worlds)
        chosen = pairs(generator, options.half, options.world, options.profile, quick=options.quick)
        limit = options.limit or (QUICK_LIMIT if options.quick else LIMIT)
        if options.localise:
            _localise(generator, chosen, options, limit)
            return
        if options.bags:
            bags = [_bag_row(generator, *each, options, limit) for each in chosen]
            print(f"{options.half} half, {len(bags)} bags of at most {limit} keyframes")
            print(bags_table(bags))
            _write(options.json, bags)
            return
        cases = _cases(generator, chosen, options, limit)
        if options.lost:
            lost = [
                lost_row(
                    generator,
                    case,
                    stranger_of(generator, options.half, _world(case)),
                    limit,
                    options.seed,
                )
                for case in cases
                if _world(case) in world_names(generator)
            ]
            print(f"{options.half} half: turns of 20 keyframes")
            print(lost_table(lost))
            _write(options.json, lost)
            return
        if options.align:
            aligned = list(align_rows(cases, options.seed))
            print(f"{options.half} half, {options.moved:g} of the movable things moved")
            print(align_table(aligned))
            _write(options.json, aligned)
            return
        if options.jumps:
            chance = np.random.default_rng(options.seed)
            jumps = [row for case in cases for row in jump_rows(case, chance)]
            print(f"{options.half} half, jumps of 2 to 8 m")
            print(jump_table(jumps))
            _write(options.json, jumps)
            return
        if options.ask:
            asked = [_asked_row(generator, case, options) for case in cases]
            print(f"{options.half} half, {options.moved:g} of the movable things moved")
            print(asked_table(asked))
            _write(options.json, asked)
            return
        if options.places:
            rules = {**RULES, "rooms": RULES["rooms"].with_assignments(options.set)}
            places = [
                places_row(case, rules, world_walls(generator, _world(case)) if walled else None)
                for case in cases
                if not (walled := options.walls) or _world(case) in world_names(generator)
            ]
        elif options.types:
            ruled = [RULES["rooms"].model_copy(update={"fusion": f}) for f in ("page", "evidence")]
            by_rule = [settings.with_assignments(options.set) for settings in ruled]
            types = [types_row(case, settings) for case in cases for settings in by_rule]
        else:
            rows = [_row(case, options) for case in cases]
    except (NoWorldsError, SettingsError) as error:
        sys.exit(str(error))
    print(
        f"{options.half} half, {len(chosen)} of world × profile, at most {limit} keyframes a run"
        + (f", {options.moved:g} of the movable things moved" if options.moved else "")
        + ("" if options.embeddings else ", no embeddings: page goes by class and radius alone")
    )
    if options.places:
        print(places_table(places))
        _write(options.json, places)
        return
    if options.types:
        print(types_table(types))
        _write(options.json, types)
        return
    if options.calibrated:
        print(calibration_table(rows))
    print(tables.moved_table(rows) if options.moved else tables.objects_table(rows))
    if options.moved:
        print(told_table((row.name, row.told) for row in rows if row.told is not None))
    _write(options.json, rows)


def _bag_row(
    generator: ModuleType, profile: str, world: str, options: argparse.Namespace, limit: int
) -> BagRow:
    folder = case_folder(generator, profile, world, 0.0, limit, options.seed, options.cache)
    return bag_row(options.worlds / "make_bag.py", folder, profile, world)


def _world(case: Case) -> str:
    """The building of a case; house-a, whose walls are not known, is in no generator."""
    return case.name.rpartition(" ")[2]


def _write(
    path: Path | None,
    rows: Sequence[
        tables.Row | PlacesRow | TypesRow | BagRow | AskedRow | AlignRow | JumpRow | LostRow
    ],
) -> None:
    if path is not None:
        document = [dataclasses.asdict(row) for row in rows]
        path.write_text(json.dumps(document, indent=1) + "\n")


def _localise(
    generator: ModuleType, chosen: list[tuple[str, str]], options: argparse.Namespace, limit: int
) -> None:
    make = functools.partial(
        make_case,
        generator,
        limit=limit,
        seed=options.seed,
        cache=options.cache,
        embeddings=options.embeddings,
        session_shift=options.session_shift,
    )
    rows: list[LocaliseRow] = []
    cases = [(p, w, stranger_of(generator, options.half, w)) for p, w in chosen]
    for profile, *worlds in cases:
        for world in worlds:
            make(profile, world)  # so that no two processes generate the same
    with ProcessPoolExecutor(options.jobs) as pool:
        for found in pool.map(functools.partial(_localised, limit, options), cases):
            rows += found
    print(
        f"{options.half} half, {len(chosen)} of world × profile, at most {limit} keyframes a run, "
        f"every {options.every}. question of runs b and c, as many of another building"
    )
    print(localise_table(rows, lines=not options.brief))
    if options.json:
        options.json.write_text(json.dumps([row.document() for row in rows], indent=1) + "\n")


def _localised(
    limit: int, options: argparse.Namespace, case: tuple[str, str, str]
) -> list[LocaliseRow]:
    profile, world, other = case
    generator = load_generator(options.worlds)
    own, stranger = (
        make_case(
            generator,
            profile,
            each,
            limit=limit,
            seed=options.seed,
            cache=options.cache,
            embeddings=options.embeddings,
            session_shift=options.session_shift,
        )
        for each in (world, other)
    )
    return localise(own, stranger, options.map, options.every, stated=not options.no_camera)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="scripts/bench_truth", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument("--half", choices=("develop", "validate"), default="develop")
    parser.add_argument("--quick", action="store_true", help="each world with one profile")
    parser.add_argument("--world", nargs="+", default=[], metavar="W")
    parser.add_argument("--profile", nargs="+", default=[], metavar="P")
    parser.add_argument(
        "--moved", type=float, default=0.0, help="share of the movable things moved after run a"
    )
    parser.add_argument(
        "--calibrated", action="store_true", help="the map's own constants beside the priors"
    )
    parser.add_argument(
        "--no-embeddings",
        dest="embeddings",
        action="store_false",
        help="bare detectors: classes and boxes",
    )
    parser.add_argument("--places", action="store_true", help="places against rooms, no Objects")
    parser.add_argument(
        "--walls", action="store_true", help="with --places: rooms with an occupancy map, too"
    )
    parser.add_argument(
        "--bags", action="store_true", help="bags of ROS 2 with walls, imported without an option"
    )
    parser.add_argument("--types", action="store_true", help="types of places against room names")
    parser.add_argument(
        "--ask", action="store_true", help="find, changes and goals; with --moved, instead"
    )
    parser.add_argument(
        "--align", action="store_true", help="runs in frames of their own find each other, instead"
    )
    parser.add_argument(
        "--jumps", action="store_true", help="frames that jump in the middle of a run, instead"
    )
    parser.add_argument("--lost", action="store_true", help="robots that turn on the spot, instead")
    parser.add_argument("--localise", action="store_true", help="where the robot is, instead")
    parser.add_argument(
        "--no-camera", action="store_true", help="with --localise: maps estimate the field of view"
    )
    parser.add_argument(
        "--session-shift",
        type=float,
        default=1.0,
        metavar="F",
        help="with --localise: runs differ F times as much in looks",
    )
    parser.add_argument("--every", type=int, default=1, metavar="N", help="ask every N-th question")
    parser.add_argument("--map", nargs="+", choices=MAPS, default=MAPS, help="rules of the maps")
    parser.add_argument("--brief", action="store_true", help="with --localise: means only")
    parser.add_argument("--jobs", type=int, default=1, help="with --localise: processes")
    parser.add_argument("--seed", type=int, default=SEED, help=f"of the generator ({SEED})")
    parser.add_argument("--limit", type=int, help=f"most keyframes a run ({LIMIT})")
    parser.add_argument(
        "--set", nargs="+", default=[], metavar="NAME=VALUE", help="settings of the rule measured"
    )
    parser.add_argument("--worlds", type=Path, default=WORLDS, help="folder of make_worlds.py")
    parser.add_argument("--cache", type=Path, default=CACHE, help="where generated runs are kept")
    parser.add_argument("--json", type=Path, help="write the scores here too")
    return parser.parse_args()


def _cases(
    generator: object, chosen: list[tuple[str, str]], options: argparse.Namespace, limit: int
) -> Iterator[Case]:
    for profile, world in chosen:
        print(f"\r{profile} {world} …\033[K", end="", file=sys.stderr, flush=True)
        yield make_case(
            generator,
            profile,
            world,
            moved=options.moved,
            limit=limit,
            seed=options.seed,
            cache=options.cache,
            embeddings=options.embeddings,
        )
    print("\r\033[K", end="", file=sys.stderr, flush=True)
    if options.moved or options.world or options.profile:
        return
    house = house_case(embeddings=options.embeddings)
    if house is None:
        print("house-a is left out: its data is absent; see MAPFOLD_SHARED_DATA", file=sys.stderr)
    else:
        yield house


def _row(case: Case, options: argparse.Namespace) -> tables.Row:
    plain = case.events if options.embeddings else list(map(as_if_alike, case.events))
    page, page_s = fold_timed(plain, Settings())
    settings = Settings(fusion="evidence", camera=case.camera_settings)
    settings = settings.with_assignments(options.set)
    evidence, evidence_s = fold_timed(case.events, settings)
    calibrated, calibrated_s = None, 0.0
    if options.calibrated:
        own, calibrated_s = calibrated_settings(case.events, settings)
        calibrated = score_objects(fold_timed(case.events, own)[0], case.truth, case.things)
    moved = (case.truth, case.things, case.first_run, case.looks_again)
    return tables.Row(
        case.name,
        len(case.events),
        score_objects(page, case.truth, case.things),
        score_objects(evidence, case.truth, case.things),
        page_s,
        evidence_s,
        score_moved(evidence, *moved) if options.moved else None,
        score_moved(evidence, *moved, least_seen=2, least_looks=3) if options.moved else None,
        calibrated,
        calibrated_s,
        _told(case, settings) if options.moved else None,
    )


def _told(case: Case, settings: Settings) -> ToldScores:
    """What a difference of the maps after run a and after run b says."""
    return score_told(*_two_maps(case, settings), case.truth, case.things)


def _two_maps(
    case: Case, settings: Settings, walls: OccupancyMap | None = None
) -> tuple[MapView, MapView]:
    """The maps after run a and after run b."""
    runs = list(dict.fromkeys(each.envelope.run_id for each in case.events))
    before, after = (
        fold_timed([e for e in case.events if e.envelope.run_id in runs[:count]], settings, walls)[
            0
        ]
        for count in (1, 2)
    )
    return before, after


def _asked_row(generator: ModuleType, case: Case, options: argparse.Namespace) -> AskedRow:
    profile, world = case.name.split()
    building = Building(generator, world, profile, options.moved, options.seed)
    settings = Settings(fusion="evidence", camera=case.camera_settings)
    maps = _two_maps(case, settings, world_walls(generator, world).map)
    return asked_row(case.name, *maps, case.truth, case.things, generator.SYNONYMS, building)


if __name__ == "__main__":
    main()
