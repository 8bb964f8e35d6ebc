"""The demo's stages in order: record, replay, map, correct, ask, draw; then commands to go on with.

House and runs are made before the time is taken: simulating them is no part of mapfold.
"""

import contextlib
import os
import shlex
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from eventsrc.adapters.sim import DEFAULT_SEED, occupancy_map, simulate_run
from eventsrc.base.text import command_line
from eventsrc.base.user_files import write_files
from eventsrc.envelope.system_events import MAP_KEY
from eventsrc.log import LogWriter
from projections.adapters.drawing import draw_map, floor_of
from projections.adapters.drawing.picture import bridges_of
from projections.fold.settings import PRESETS, Settings
from projections.postgres import rebuild
from projections.postgres.connection import Targets, open_targets
from projections.postgres.embedded import EmbeddedServer

from . import report
from .asking import ask_lost, place_rooms
from .correcting import correct
from .folder import DemoFolder, fresh_folder
from .mapping import RoomMerge, fold_with_rooms, hash_tables, most_telling, places_with
from .recording import record_run
from .report import DemoResult, result_document

SETTINGS: Final = Settings().with_assignments(PRESETS["rooms"])
"""With the default settings the whole house becomes one place."""


@dataclass(frozen=True, slots=True)
class DemoOptions:
    """Output folder, house, speed of the robot, and databases if not the demo's own."""

    out: Path
    seed: int = DEFAULT_SEED
    speed: float = 30.0
    db: str | None = None
    vector_db: str | None = None


PrintLine = Callable[[str], None]


def run_demo(options: DemoOptions, print_line: PrintLine) -> dict[str, Any]:
    """Run the demo; ``print_line`` gets each line of its report. Returns its numbers for JSON."""
    with fresh_folder(options.out) as folder:
        return _play(options, folder, print_line)


def _play(options: DemoOptions, folder: DemoFolder, print_line: PrintLine) -> dict[str, Any]:
    explorer, lost_run = simulate_run(options.seed, "a"), simulate_run(options.seed, "b")
    settings = SETTINGS.model_dump_json(indent=2) + "\n"
    write_files({folder.settings: settings.encode()})
    clock = _Stages(print_line)
    house = explorer.house
    detections = sum(len(envelope["detections"]) for envelope in explorer.envelopes)
    rooms = len(house.plan.rooms)
    with contextlib.ExitStack() as stack:
        with clock.stage("Run A explores the house and is recorded"):
            targets = stack.enter_context(_databases(folder, options))
            with LogWriter(folder.log) as writer:
                writer.append(MAP_KEY, occupancy_map(house).encode())
            recorded, followed = record_run(explorer, options.speed, folder, targets, SETTINGS)
            clock.show(report.recording_lines(recorded, followed, detections, rooms, options.speed))
        with clock.stage("The databases are thrown away and the log is replayed"):
            before = hash_tables(targets)
            replayed = rebuild(folder.log, targets, SETTINGS)
            same_rows = hash_tables(targets) == before
            folded = fold_with_rooms(folder, SETTINGS, explorer)
            clock.show(report.replay_lines(replayed, folded, same_rows))
        with clock.stage("The map"):
            default_places = places_with(folder, Settings())
            clock.show(report.map_lines(folded, Settings(), default_places))
            clock.show(report.type_lines(folded.view))
            clock.show(report.merge_lines(folded.merges))
        with clock.stage("A person corrects the map"):
            corrected = correct(folder, targets, SETTINGS, explorer, folded)
            clock.show(report.correction_lines(corrected))
        with clock.stage("Run B is lost and asks"):
            lost = ask_lost(targets, lost_run, folder)
            clock.show(report.question_lines(lost, place_rooms(corrected.folded.view, explorer)))
    with clock.stage("The map is drawn"):
        draw_map(
            corrected.folded.view,
            folder.map,
            title=f"House {house.seed}: explored by {explorer.run_id}, {lost.run_id} lost in it",
            floor=floor_of(house),
            lost=lost.drawing,
            bridges=bridges_of(corrected.folded.view, corrected.folded.deltas),
        )
        clock.show([f"   {folder.map}"])
    print_line(f"{clock.total:.1f} s in all. Go on with it:")
    clock.show(_next_commands(folder, most_telling(folded.merges), options.db, options.vector_db))
    return result_document(
        DemoResult(
            options.seed, SETTINGS, recorded, followed, replayed, same_rows, folded, corrected, lost
        ),
        clock.seconds,
        folder,
    )


class _Stages:
    def __init__(self, print_line: PrintLine) -> None:
        self._print_line = print_line
        self.seconds: dict[str, float] = {}

    @property
    def total(self) -> float:
        return sum(self.seconds.values())

    def show(self, lines: Iterable[str]) -> None:
        for line in lines:
            self._print_line(line)

    @contextlib.contextmanager
    def stage(self, name: str) -> Iterator[None]:
        self._print_line(f"{len(self.seconds) + 1}. {name}")
        started = time.monotonic()
        yield
        self.seconds[name] = time.monotonic() - started
        self._print_line(f"   [{self.seconds[name]:.1f} s]")


@contextlib.contextmanager
def _databases(folder: DemoFolder, options: DemoOptions) -> Iterator[Targets]:
    """The user's databases if given, else a server of the demo's own, in its folder.

    Not the user's embedded server, nor what MAPFOLD_DB names: the demo must not replace their map.
    """
    if options.db is not None:
        with open_targets(options.db, options.vector_db or options.db) as targets:
            yield targets
        return
    with EmbeddedServer(folder.path) as server:
        yield Targets(server.url, options.vector_db or server.url, server)


def _next_commands(
    folder: DemoFolder, merge: RoomMerge | None, db: str | None, vector_db: str | None
) -> Iterator[str]:
    """Commands to paste into a POSIX shell, with comments. A test runs them."""
    if shutil.which("mapfold") is None:
        activate = Path(sys.prefix) / "bin" / "activate"
        yield f"   . {_quoted(_relative(activate))}    # puts mapfold on the path"
    if db is None:
        yield f"   export MAPFOLD_HOME={_quoted(folder.path)}    # where the databases are"
    if db is not None or vector_db is not None:  # a URL may hold a password: not printed
        yield "   # and MAPFOLD_DB, MAPFOLD_VECTOR_DB set to what --db and --vector-db were given"
    log, settings = folder.log, ("--settings", folder.settings)
    yield f"   {command_line('state', log, *settings)}"
    if merge is not None:
        before_and_behind = merge.offset, merge.offset + 1
        yield f"   {command_line('diff', log, *before_and_behind, *settings)}    # that merge"
        yield f"   {command_line('merges', log, *settings, '--refused')}    # undone since"
    yield f"   {command_line('edits', log, *settings)}"
    yield f"   {command_line('relocalize', folder.question(1))}"
    yield f"   {command_line('status', log, *settings)}"
    shown = ("--at", merge.offset + 1, "--select", f"merge:{merge.offset}") if merge else ()
    yield f"   {command_line('ui', log, *settings, *shown)}    # in a browser"


def _relative(path: Path) -> Path:
    """Relative to the current folder if inside it."""
    here = Path.cwd()
    return path.relative_to(here) if path.is_relative_to(here) else path


def _quoted(path: Path) -> str:
    return shlex.quote(os.fspath(path))
