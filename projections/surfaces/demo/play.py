"""The demo's stages in order: record, replay, map, correct, ask, draw; then commands to go on with.

House and runs are made before the time is taken: simulating them is no part of mapfold.

The output folder is emptied at the start, if a demo made it, which a file named ``MARKER`` says.
The database server's files in it are kept, because making them takes longest and a replay replaces
what is in them. A running demo holds a lock on ``MARKER``: a second one would remove its log.
"""

import contextlib
import fcntl
import os
import shlex
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Final

from eventsrc.adapters.sim import simulate_run
from eventsrc.base.errors import MisuseError
from eventsrc.base.text import command_line
from eventsrc.log import LogWriter
from projections import history
from projections.adapters.drawing import LostRobot, MergeMark, Spot, draw_map, plan_of
from projections.adapters.drawing.map_picture import merge_marks
from projections.postgres import rebuild
from projections.postgres.check import check
from projections.postgres.connection import Targets, open_targets
from projections.postgres.embedded import EmbeddedServer
from projections.surfaces.python import Map, Settings, fold

from . import story
from .acts import (
    SETTINGS,
    LostRun,
    RoomMerge,
    ask_lost,
    begin_log,
    correct,
    explore,
    most_telling,
    place_rooms,
)
from .recorded_run import record_run

MARKER: Final = ".mapfold-demo"
_GENERATED: Final = ("map.png", "question-*.json", "record.txt", "simulate.txt")


@contextlib.contextmanager
def fresh_folder(path: Path) -> Iterator[Path]:
    """An empty demo folder at ``path``, locked until the end.

    Raises MisuseError when something else is there, or another demo is at work in it.
    """
    with contextlib.ExitStack() as held:
        try:
            _lock(path, held)
            if (path / "log").exists():
                shutil.rmtree(path / "log")
            for pattern in _GENERATED:
                for old in path.glob(pattern):
                    old.unlink()
        except OSError as error:
            raise MisuseError(f"{path}: {error.strerror}; choose another --out") from None
        yield path


def _lock(path: Path, held: contextlib.ExitStack) -> None:
    """Mark the folder, and lock the mark for as long as ``held`` is; see `fresh_folder`."""
    if path.exists() and not (path / MARKER).exists() and any(path.iterdir()):
        raise MisuseError(
            f"{path}: not empty and not made by the demo; choose another --out or remove it"
        )
    path.mkdir(parents=True, exist_ok=True)
    mark = held.enter_context((path / MARKER).open("a"))
    try:
        fcntl.flock(mark, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise MisuseError(
            f"{path}: another demo is at work there; wait for it or choose another --out"
        ) from None
    mark.truncate(0)
    mark.write("made by mapfold demo; the next one removes it\n")
    mark.flush()


def run_demo(
    out: Path,
    seed: int,
    speed: float,
    db: str | None,
    vector_db: str | None,
    print_line: Callable[[str], None],
) -> dict[str, Any]:
    """Run the demo; ``print_line`` gets each line of its report. Returns its numbers for JSON.

    ``speed`` is that of the robot, ``db`` and ``vector_db`` are databases if not the demo's own.
    """
    explorer, lost_run = simulate_run(seed, "a"), simulate_run(seed, "b")
    house, clock = explorer.house, _Stages(print_line)
    detections = sum(len(envelope["detections"]) for envelope in explorer.envelopes)
    with fresh_folder(out) as folder, contextlib.ExitStack() as stack:
        log = folder / "log"
        with clock.stage("Run A explores the house and is recorded"):
            targets = stack.enter_context(_databases(folder, db, vector_db))
            with LogWriter(log) as writer:
                begin_log(writer, house)
            recorded, followed = record_run(explorer, speed, folder, targets, SETTINGS)
            rooms = len(house.plan.rooms)
            clock.show(story.recording_lines(recorded, followed, detections, rooms, speed))
        with clock.stage("The databases are thrown away and the log is replayed"):
            tailed = _have_rows(log, targets)
            replayed = rebuild(log, targets, SETTINGS)
            same_rows = tailed and _have_rows(log, targets)
            explored = explore(log, explorer)
            clock.show(story.replay_lines(replayed, explored.house, same_rows))
        with clock.stage("The map"):
            default_places = len(fold(log, settings=Settings(), embeddings=False).places)
            clock.show(story.map_lines(explored.house, Settings(), default_places))
            clock.show(story.type_lines(explored.house))
            clock.show(story.merge_lines(explored.merges))
        with clock.stage("A person corrects the map"):
            corrected = correct(log, targets, explorer, explored)
            clock.show(story.correction_lines(corrected))
        with clock.stage("Run B is lost and asks"):
            lost = ask_lost(targets, lost_run, folder)
            clock.show(story.question_lines(lost, place_rooms(corrected.house, explorer)))
        with clock.stage("The map is drawn"):
            draw_map(
                corrected.house.view,
                folder / "map.png",
                title=f"House {seed}: explored by {explorer.run_id}, {lost.run_id} lost in it",
                plan=plan_of(house),
                lost=_where_lost(lost),
                marks=_merge_marks(log, corrected.house),
            )
            clock.show([f"   {folder / 'map.png'}"])
    print_line(f"{clock.total:.1f} s in all. Go on with it:")
    clock.show(_next_commands(folder, most_telling(explored.merges), db, vector_db))
    done = story.DemoResult(
        seed, SETTINGS, recorded, followed, replayed, same_rows, explored, corrected, lost
    )
    return story.result_document(done, clock.seconds, folder)


class _Stages:
    def __init__(self, print_line: Callable[[str], None]) -> None:
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
def _databases(folder: Path, db: str | None, vector_db: str | None) -> Iterator[Targets]:
    """The user's databases if given, else a server of the demo's own, in its folder.

    Not the user's embedded server, nor what MAPFOLD_DB names: the demo must not replace their map.
    """
    if db is not None:
        with open_targets(db, vector_db or db) as targets:
            yield targets
        return
    with EmbeddedServer(folder) as server:
        yield Targets(server.url, vector_db or server.url, server)


def _have_rows(log: Path, targets: Targets) -> bool:
    """Whether the databases have exactly the rows of the log's fold."""
    return not any(report.differing for report in check(log, targets, SETTINGS))


def _where_lost(lost: LostRun) -> LostRobot:
    """The lost robot and the last question's estimate of its pose."""
    pose, truth = lost.questions[-1].answer.pose, Spot(**lost.truth)
    if pose is None:
        return LostRobot(truth, None)
    return LostRobot(truth, Spot(pose.x, pose.y, pose.yaw), pose.spread_m)


def _merge_marks(log: Path, house: Map) -> list[MergeMark]:
    """A mark for each merge that the corrections left."""
    with history.LogTimeline(log, lambda _: SETTINGS, cache=False) as timeline:
        merges = timeline.knowing(timeline.end).merges(timeline.end)
    return merge_marks(house.view, merges)


def _next_commands(
    folder: Path, merge: RoomMerge | None, db: str | None, vector_db: str | None
) -> Iterator[str]:
    """Commands to paste into a POSIX shell, with comments. A test runs them."""
    if shutil.which("mapfold") is None:
        activate = Path(sys.prefix) / "bin" / "activate"
        yield f"   . {_quoted(_relative(activate))}    # puts mapfold on the path"
    if db is None:
        yield f"   export MAPFOLD_HOME={_quoted(folder)}    # where the databases are"
    if db is not None or vector_db is not None:  # a URL may hold a password: not printed
        yield "   # and MAPFOLD_DB, MAPFOLD_VECTOR_DB set to what --db and --vector-db were given"
    log = folder / "log"
    yield f"   {command_line('state', log)}"
    if merge is not None:
        before_and_behind = merge.offset, merge.offset + 1
        yield f"   {command_line('diff', log, *before_and_behind)}    # that merge"
        yield f"   {command_line('merges', log, '--refused')}    # undone since"
    yield f"   {command_line('edits', log)}"
    yield f"   {command_line('relocalize', folder / 'question-1.json')}"
    yield f"   {command_line('status', log)}"
    shown = ("--at", merge.offset + 1, "--select", f"merge:{merge.offset}") if merge else ()
    yield f"   {command_line('ui', log, *shown)}    # in a browser"


def _relative(path: Path) -> Path:
    """Relative to the current folder if inside it."""
    here = Path.cwd()
    return path.relative_to(here) if path.is_relative_to(here) else path


def _quoted(path: Path) -> str:
    return shlex.quote(os.fspath(path))
