"""The demo's stages in order: record, replay, map, correct, ask, draw; then commands to go on with.

House and runs are made before the time is taken: simulating them is no part of mapfold. The map
knows no rooms; the truth beside a run does.
"""

import contextlib
import json
import math
import os
import shlex
import shutil
import statistics
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from eventsrc.adapters.sim import SimulatedRun, simulate_run
from eventsrc.base.text import command_line
from eventsrc.base.user_files import write_files
from eventsrc.record.transport.session import ZenohOptions, open_session
from projections import history
from projections.adapters.drawing import LostRobot, Spot, draw_map, plan_of
from projections.adapters.drawing.map_picture import merge_marks
from projections.edit.make import Stamp, name_place, undo_merge
from projections.edit.record import MakeCommand, record_command
from projections.localize.relocalize import rank, read_question
from projections.postgres import rebuild
from projections.postgres.check import check
from projections.postgres.connection import Targets, open_targets
from projections.postgres.embedded import EmbeddedServer
from projections.postgres.queries.candidate_search import CandidateReader
from projections.surfaces.python import Map, Settings, Timeline, fold

from . import story
from .recorded_run import SETTINGS, fresh_folder, record_run

MOST_CROPS: Final = 3


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
    seconds: dict[str, float] = {}
    explorer, lost_run = simulate_run(seed, "a"), simulate_run(seed, "b")
    with fresh_folder(out) as folder, contextlib.ExitStack() as stack:
        play = _Play(folder, explorer, lost_run, speed, db, vector_db, stack)
        stages: dict[str, Callable[[], Iterable[str]]] = {
            "Run A explores the house and is recorded": play.record,
            "The databases are thrown away and the log is replayed": play.replay,
            "The map": play.show_map,
            "A person corrects the map": play.correct,
            "Run B is lost and asks": play.ask,
            "The map is drawn": play.draw,
        }
        for number, (name, stage) in enumerate(stages.items(), start=1):
            print_line(f"{number}. {name}")
            started = time.monotonic()
            for line in stage():
                print_line(f"   {line}")
            seconds[name] = time.monotonic() - started
            print_line(f"   [{seconds[name]:.1f} s]")
    total = sum(seconds.values())
    print_line(f"{total:.1f} s in all. Go on with it:")
    for line in play.next_commands():
        print_line(f"   {line}")
    files = {"folder": folder, "log": play.log, "map": folder / "map.png"}
    return {
        "sound": story.is_sound(play.numbers),
        "seed": seed,
        "settings": SETTINGS.model_dump(),
        **play.numbers,
        "seconds": {**seconds, "total": total},
        "files": {name: str(path) for name, path in files.items()},
    }


@dataclass(slots=True)
class _Play:
    """Each stage does its part, puts its ``numbers`` by, and yields the lines of its report."""

    folder: Path
    explorer: SimulatedRun
    lost_run: SimulatedRun
    speed: float
    db: str | None
    vector_db: str | None
    stack: contextlib.ExitStack
    numbers: dict[str, Any] = field(default_factory=dict)
    targets: Targets = field(init=False)
    house: Map = field(init=False)

    @property
    def log(self) -> Path:
        return self.folder / "log"

    def record(self) -> Iterator[str]:
        self.targets = self.stack.enter_context(self._databases())
        recorded, tailed = record_run(self.explorer, self.speed, self.folder, self.targets)
        self.numbers |= {"record": recorded, "tail": tailed}
        detections = sum(len(envelope["detections"]) for envelope in self.explorer.envelopes)
        rooms = len(self.explorer.house.plan.rooms)
        yield from story.recording_lines(recorded, tailed, detections, rooms, self.speed)

    @contextlib.contextmanager
    def _databases(self) -> Iterator[Targets]:
        """The user's databases if given, else a server of the demo's own, in its folder.

        Not the user's embedded server, nor what MAPFOLD_DB names: the demo must not replace their
        map.
        """
        if self.db is not None:
            with open_targets(self.db, self.vector_db or self.db) as targets:
                yield targets
            return
        with EmbeddedServer(self.folder) as server:
            yield Targets(server.url, self.vector_db or server.url, server)

    def replay(self) -> Iterator[str]:
        tailed = self._have_rows()
        replayed = rebuild(self.log, self.targets, SETTINGS)
        self.numbers["replay"] = {
            "rows": replayed.rows,
            "same_rows_as_tail": tailed and self._have_rows(),
            "digest": replayed.digest,
            "seconds": replayed.total_s,
        }
        started = time.monotonic()
        self.house = fold(self.log)
        with Timeline(self.log, cache=False) as timeline:
            merges = [self._rooms_of(each, timeline) for each in timeline.merges()]
        counts = self.house.state["counts"]
        self.numbers["map"] = {
            "keyframes": counts["keyframes"],
            "places": counts["places"],
            "objects": counts["objects"],
            "adjacent_pairs": counts["adjacency"],
            "transitions": story.transitions(self.house),
            "digest": self.house.digest,
            "fold_seconds": time.monotonic() - started,
        }
        self.numbers["merges"] = merges
        yield from story.replay_lines(self.numbers["replay"], self.house.digest)

    def _have_rows(self) -> bool:
        """Whether the databases have exactly the rows of the log's fold."""
        return not any(report.differing for report in check(self.log, self.targets, SETTINGS))

    def _rooms_of(self, merge: dict[str, Any], timeline: Timeline) -> dict[str, Any]:
        """A merge of places, and which rooms they were in."""
        before = timeline.at(merge["offset"])
        rooms = self._place_rooms(before)
        bridge_room = self._true_rooms[merge["keyframe_id"]]
        survivor, *absorbed = (
            {"place_id": place, "keyframes": size, "room": rooms.get(place, bridge_room)}
            for place, size in zip(
                (merge["survivor"], *merge["absorbed"]),
                (merge["survivor_size"], *merge["absorbed_sizes"]),
                strict=True,
            )
        )
        return {
            **{key: merge[key] for key in ("offset", "run_id", "keyframe_id")},
            "bridge_room": bridge_room,
            "survivor": survivor,
            "absorbed": absorbed,
            "places_before": len(before.places),
        }

    @property
    def _true_rooms(self) -> dict[int, str]:
        return {line["keyframe_id"]: str(line["room"]) for line in self.explorer.truth}

    def _place_rooms(self, house: Map) -> dict[str, str]:
        """For each place the room most of its keyframes were truly taken in."""
        rooms, seen = self._true_rooms, defaultdict[str, Counter[str]](Counter)
        for keyframe in house.state["keyframes"]:
            if keyframe["place_id"] is not None:
                seen[keyframe["place_id"]][rooms[keyframe["keyframe_id"]]] += 1
        return {place: max(sorted(count), key=count.__getitem__) for place, count in seen.items()}

    def show_map(self) -> Iterator[str]:
        classic = Settings()
        places = len(fold(self.log, settings=classic, embeddings=False).places)
        yield from story.map_lines(self.house, classic, places)
        yield from story.type_lines(self.house)
        yield from story.merge_lines(self.numbers["merges"])

    def correct(self) -> Iterator[str]:
        """Undo the most telling merge, name the absorbed place after its room (the largest place if
        none merged), fold again, and rebuild the databases."""
        started, merge = time.monotonic(), story.most_telling(self.numbers["merges"])
        for kind, reason, make in self._corrections(merge):
            record_command(
                self.log,
                make,
                Stamp(f"demo-{kind}", "demo@mapfold", reason),
                settings_of=lambda _: SETTINGS,
                open_session=lambda: open_session(ZenohOptions(), mode="client"),
            )
        self.house = house = fold(self.log)
        replayed = rebuild(self.log, self.targets, SETTINGS)
        rooms = self._place_rooms(house)
        parts = {
            (id_ := place["place_id"]): {
                "place_id": id_,
                "keyframes": place["keyframe_count"],
                "room": rooms[id_],
            }
            for place in house.places
        }
        named = [each["place_id"] for each in house.places if each.get("name") is not None]
        were_one = [each["place_id"] for each in story.parts_of(merge)[:2]] if merge else []
        self.numbers["corrected"] = corrected = {
            "commands": list(house.state.get("corrections", {}).get("commands", ())),
            "named": parts[named[0]] if named else None,
            "apart": [part for place, part in parts.items() if place in were_one],
            "places": len(house.places),
            "digest": house.digest,
            "replay_digest": replayed.digest,
            "replay_seconds": replayed.total_s,
            "seconds": time.monotonic() - started,
        }
        yield from story.correction_lines(corrected)

    def _corrections(self, merge: story.Numbers | None) -> Iterator[tuple[str, str, MakeCommand]]:
        """The kind, the reason and the maker of each command."""
        if merge is not None:
            place, room = (merge["absorbed"][0][key] for key in ("place_id", "room"))
            why = "these are two rooms" if story.across_rooms(merge) else f"two ends of the {room}"
            yield "undo-merge", why, lambda c, s: undo_merge(c, s, merge["offset"])
        elif self.house.places:
            place = max(self.house.places, key=lambda p: p["keyframe_count"])["place_id"]
            room = self._place_rooms(self.house)[place]
        else:
            return
        yield "name-place", "so that people know it", lambda c, s: name_place(c, s, place, room)

    def ask(self) -> Iterator[str]:
        """Ask the databases where run B is, by questions of a few crops without a pose.

        The first question is chosen regardless of the answer: the picture near the start with the
        most detections, counting at most three; of several the first. It is asked with the most
        confident of them, then with two, then three. Afterwards every keyframe of the run that
        shows anything is asked once, to measure single questions.
        """
        run, asked = self.lost_run, []
        index = _first_question(run)
        best = _most_confident(run.envelopes[index])
        with CandidateReader(self.targets) as reader:
            for count in range(1, len(best) + 1):
                text = json.dumps({"crops": best[:count]}) + "\n"
                write_files({self.folder / f"question-{count}.json": text.encode()})
                asked.append(_ask(reader, run, index, best[:count]))
            started = time.monotonic()
            every = [
                _ask(reader, run, number, _most_confident(envelope))
                for number, envelope in enumerate(run.envelopes)
                if envelope["detections"]
            ]
        known = [a["error_m"] for a in every if a["error_m"] is not None and not a["unknown"]]
        pose, truth = run.true_poses[index], run.truth[index]
        self.numbers["relocalize"] = lost = {
            "run_id": run.run_id,
            "keyframe_id": truth["keyframe_id"],
            "room": truth["room"],
            "truth": {"x": pose.x, "y": pose.y, "yaw_rad": pose.yaw_rad},
            "questions": asked,
            "everywhere": {
                "asked": len(every),
                "unknown": len(every) - len(known),
                "near": sum(error <= story.NEAR_M for error in known),
                "median_error_m": statistics.median(known) if known else math.nan,
                "seconds": time.monotonic() - started,
            },
        }
        yield from story.question_lines(lost, self._place_rooms(self.house))

    def draw(self) -> Iterator[str]:
        lost, out = self.numbers["relocalize"], self.folder / "map.png"
        pose = lost["questions"][-1]["pose"]
        estimate = pose and Spot(pose["x"], pose["y"], pose["yaw"])
        with history.LogTimeline(self.log, lambda _: SETTINGS, cache=False) as timeline:
            merges = timeline.knowing(timeline.end).merges(timeline.end)
        draw_map(
            self.house.view,
            out,
            title=f"House {self.explorer.house.seed}: explored by {self.explorer.run_id}, "
            f"{self.lost_run.run_id} lost in it",
            plan=plan_of(self.explorer.house),
            lost=LostRobot(Spot(**lost["truth"]), estimate, pose and pose["spread_m"]),
            marks=merge_marks(self.house.view, merges),
        )
        yield f"{out}"

    def next_commands(self) -> Iterator[str]:
        """Commands to paste into a POSIX shell, with comments. A test runs them."""
        if shutil.which("mapfold") is None:
            activate = Path(sys.prefix) / "bin" / "activate"
            yield f". {_quoted(_relative(activate))}    # puts mapfold on the path"
        if self.db is None:
            yield f"export MAPFOLD_HOME={_quoted(self.folder)}    # where the databases are"
        if self.db is not None or self.vector_db is not None:  # may hold a password: not printed
            yield "# and MAPFOLD_DB, MAPFOLD_VECTOR_DB set to what --db and --vector-db were given"
        log, merge = self.log, story.most_telling(self.numbers["merges"])
        shown: tuple[object, ...] = ()
        yield command_line("state", log)
        if merge is not None:
            offset = merge["offset"]
            shown = ("--at", offset + 1, "--select", f"merge:{offset}")
            yield f"{command_line('diff', log, offset, offset + 1)}    # that merge"
            yield f"{command_line('merges', log, '--refused')}    # undone since"
        yield command_line("edits", log)
        yield command_line("relocalize", self.folder / "question-1.json")
        yield command_line("status", log)
        yield f"{command_line('ui', log, *shown)}    # in a browser"


def _first_question(run: SimulatedRun) -> int:
    """The first keyframe near the start with the most detections, counting at most three.

    If those have none, the first keyframe of the run that has any.
    """
    start = run.true_poses[0]
    here = [
        index
        for index, pose in enumerate(run.true_poses)
        if math.dist((pose.x, pose.y), (start.x, start.y)) < 0.05
    ]
    shown = [len(_most_confident(envelope)) for envelope in run.envelopes]
    best = max(here, key=lambda index: (shown[index], -index))
    return best if shown[best] else next(i for i, count in enumerate(shown) if count)


def _most_confident(envelope: dict[str, Any]) -> list[dict[str, Any]]:
    detections = envelope["detections"]
    return sorted(detections, key=lambda d: (-d["confidence"], d["det_id"]))[:MOST_CROPS]


def _ask(
    reader: CandidateReader, run: SimulatedRun, index: int, crops: list[dict[str, Any]]
) -> dict[str, Any]:
    """One question and its answer; ``error_m`` is None when no pose came back."""
    started = time.monotonic()
    question = read_question({"crops": crops})
    answer = rank(question, reader.candidates(question.crops))
    seconds = time.monotonic() - started
    true, pose = run.true_poses[index], answer.pose
    error = None if pose is None else math.dist((pose.x, pose.y), (true.x, true.y))
    classes = [crop["class"] for crop in crops]
    return {"classes": classes, "error_m": error, "seconds": seconds, **answer.document()}


def _relative(path: Path) -> Path:
    """Relative to the current folder if inside it."""
    here = Path.cwd()
    return path.relative_to(here) if path.is_relative_to(here) else path


def _quoted(path: Path) -> str:
    return shlex.quote(os.fspath(path))
