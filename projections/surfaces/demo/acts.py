"""What the demo does with the map: fold the log and note which rooms merged, both through the
public Python interface, correct it as ``mapfold edit`` does, and ask the databases, as ``mapfold
relocalize`` does, where a lost robot is.

The map knows no rooms; the truth beside a run does. A place's room is the one most of its keyframes
were truly taken in.
"""

import json
import math
import statistics
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from eventsrc.adapters.sim import House, SimulatedRun, occupancy_map
from eventsrc.base.user_files import write_files
from eventsrc.envelope.commands import UseSettings, encode_command
from eventsrc.envelope.model import Offset, RunId
from eventsrc.envelope.system_events import COMMAND_KEY, MAP_KEY
from eventsrc.log import LogWriter
from eventsrc.record.transport.session import ZenohOptions, open_session
from projections.edit.make import Stamp, name_place, undo_merge
from projections.edit.record import MakeCommand, record_command
from projections.fold.presets import PRESETS
from projections.localize.relocalize import rank, read_question
from projections.postgres import RebuildReport, rebuild
from projections.postgres.connection import Targets
from projections.postgres.queries.candidate_search import CandidateReader
from projections.surfaces.python import Answer, Map, Settings, Timeline, fold

SETTINGS: Final = Settings().with_assignments([*PRESETS["full"], "camera.hfov_deg=69.4"])
"""Rooms, objects by evidence, and the camera of the simulated robot."""
MOST_CROPS: Final = 3
NEAR_M: Final = 1.5
"""Error up to which an estimate counts as right; the answer's ``confidence`` has the same bound."""


def begin_log(writer: LogWriter, house: House, logged_ns: int | None = None) -> None:
    """Begin a log with the settings, as ``mapfold edit LOG use-settings`` records them,
    and the walls, as ``mapfold import --map`` does."""
    command = UseSettings(
        command_id="settings",
        issued_by="demo@mapfold",
        reason="places are rooms; the robot's camera",
        settings=SETTINGS.model_dump(mode="json"),
    )
    writer.append(COMMAND_KEY, encode_command(command), logged_ns=logged_ns)
    writer.append(MAP_KEY, occupancy_map(house).encode(), logged_ns=logged_ns)


@dataclass(frozen=True, slots=True)
class RoomPart:
    """A place: how many keyframes, and the room most of them were taken in."""

    place_id: str
    keyframes: int
    room: str


@dataclass(frozen=True, slots=True)
class RoomMerge:
    """A merge of places.

    ``bridge_room`` is where its keyframe was taken, ``places_before`` how many there were then.
    """

    offset: Offset
    run_id: RunId
    keyframe_id: int
    bridge_room: str
    survivor: RoomPart
    absorbed: tuple[RoomPart, ...]
    places_before: int

    @property
    def across_rooms(self) -> bool:
        """Whether the parts were of different rooms."""
        return len({self.survivor.room, *(part.room for part in self.absorbed)}) > 1

    @property
    def smallest(self) -> int:
        """Keyframes of the smallest part."""
        return min(self.survivor.keyframes, *(part.keyframes for part in self.absorbed))


@dataclass(frozen=True, slots=True)
class Explored:
    """The map of the log, its merges with the rooms they joined, and the time taken."""

    house: Map
    merges: tuple[RoomMerge, ...]
    seconds: float


def explore(log: Path, run: SimulatedRun) -> Explored:
    """Fold the log, and note the rooms of every merge."""
    started = time.monotonic()
    house = fold(log)
    with Timeline(log, cache=False) as timeline:
        merges = [_room_merge(each, timeline, run) for each in timeline.merges()]
    return Explored(house, tuple(merges), time.monotonic() - started)


def _room_merge(merge: dict[str, Any], timeline: Timeline, run: SimulatedRun) -> RoomMerge:
    before = timeline.at(merge["offset"])
    rooms, bridge_room = place_rooms(before, run), _true_rooms(run)[merge["keyframe_id"]]

    def part(place: str, size: int) -> RoomPart:
        return RoomPart(place, size, rooms.get(place, bridge_room))

    return RoomMerge(
        merge["offset"],
        merge["run_id"],
        merge["keyframe_id"],
        bridge_room,
        part(merge["survivor"], merge["survivor_size"]),
        tuple(map(part, merge["absorbed"], merge["absorbed_sizes"])),
        len(before.places),
    )


def place_rooms(house: Map, run: SimulatedRun) -> dict[str, str]:
    """For each place the room most of its keyframes were truly taken in."""
    rooms = _true_rooms(run)
    seen: dict[str, Counter[str]] = defaultdict(Counter)
    for keyframe in house.state["keyframes"]:
        if keyframe["place_id"] is not None:
            seen[keyframe["place_id"]][rooms[keyframe["keyframe_id"]]] += 1
    return {place: max(sorted(count), key=count.__getitem__) for place, count in seen.items()}


def _true_rooms(run: SimulatedRun) -> dict[int, str]:
    return {line["keyframe_id"]: str(line["room"]) for line in run.truth}


def most_telling(merges: Sequence[RoomMerge]) -> RoomMerge | None:
    """The merge to describe: of different rooms if there is one, with the largest small part."""
    return max(
        merges, key=lambda merge: (merge.across_rooms, merge.smallest, -merge.offset), default=None
    )


@dataclass(frozen=True, slots=True)
class Corrected:
    """The commands that were recorded, as JSON, and the map under them.

    ``apart`` are the places that were one before, empty if no two were; ``named`` is the place that
    got the name of its room, None if the map has no place.
    """

    commands: tuple[dict[str, Any], ...]
    named: RoomPart | None
    apart: tuple[RoomPart, ...]
    house: Map
    replayed: RebuildReport
    seconds: float

    @property
    def same_digest(self) -> bool:
        """Whether the databases have the map that the log folds to."""
        return self.replayed.digest == self.house.digest


def correct(log: Path, targets: Targets, run: SimulatedRun, explored: Explored) -> Corrected:
    """Undo the merge that `most_telling` returns, name the absorbed place after its room (the
    largest place if none merged), fold again, and rebuild the databases."""
    started = time.monotonic()
    for kind, reason, make in _corrections(explored, place_rooms(explored.house, run)):
        record_command(
            log,
            make,
            Stamp(f"demo-{kind}", "demo@mapfold", reason),
            settings_of=lambda _: SETTINGS,
            open_session=lambda: open_session(ZenohOptions(), mode="client"),
        )
    house = fold(log)
    rooms, merge = place_rooms(house, run), most_telling(explored.merges)
    parted = () if merge is None else (merge.survivor.place_id, merge.absorbed[0].place_id)
    parts = [
        (place, RoomPart(place["place_id"], place["keyframe_count"], rooms[place["place_id"]]))
        for place in house.places
    ]
    return Corrected(
        tuple(house.state.get("corrections", {}).get("commands", ())),
        next((part for place, part in parts if place.get("name") is not None), None),
        tuple(part for _, part in parts if part.place_id in parted),
        house,
        rebuild(log, targets, SETTINGS),
        time.monotonic() - started,
    )


def _corrections(
    explored: Explored, rooms: dict[str, str]
) -> Iterator[tuple[str, str, MakeCommand]]:
    """The kind, the reason and the maker of each command."""
    if (merge := most_telling(explored.merges)) is not None:
        part = merge.absorbed[0]
        why = "these are two rooms" if merge.across_rooms else f"two ends of the {part.room}"
        yield "undo-merge", why, lambda c, s: undo_merge(c, s, merge.offset)
        place, room = part.place_id, part.room
    elif explored.house.places:
        place = max(explored.house.places, key=lambda p: p["keyframe_count"])["place_id"]
        room = rooms[place]
    else:
        return
    yield "name-place", "so that people know it", lambda c, s: name_place(c, s, place, room)


@dataclass(frozen=True, slots=True)
class AskedQuestion:
    """One question and its answer; ``error_m`` is None when no pose came back."""

    classes: tuple[str, ...]
    answer: Answer
    error_m: float | None
    seconds: float


@dataclass(frozen=True, slots=True)
class RunSummary:
    """One question from each of ``asked`` keyframes. Answers of "unknown" count as not near."""

    asked: int
    unknown: int
    near: int
    median_error_m: float
    seconds: float


@dataclass(frozen=True, slots=True)
class LostRun:
    """Run B's first questions, its true pose there, and a summary of its whole run."""

    run_id: RunId
    keyframe_id: int
    room: str
    truth: dict[str, float]
    questions: tuple[AskedQuestion, ...]
    everywhere: RunSummary


def ask_lost(targets: Targets, run: SimulatedRun, folder: Path) -> LostRun:
    """Ask the databases where run B is, by questions of a few crops without a pose.

    The first question is chosen regardless of the answer: the picture near the start with the most
    detections, counting at most three; of several the first. It is asked with the most confident of
    them, then with two, then three. Afterwards every keyframe of the run that shows anything is
    asked once, to measure single questions.
    """
    index = _first_question(run)
    best = _most_confident(run.envelopes[index])
    asked = []
    with CandidateReader(targets) as reader:
        for count in range(1, len(best) + 1):
            text = json.dumps({"crops": best[:count]}) + "\n"
            write_files({folder / f"question-{count}.json": text.encode()})
            asked.append(_ask(reader, run, index, best[:count]))
        everywhere = _ask_whole_run(reader, run)
    pose, truth = run.true_poses[index], run.truth[index]
    return LostRun(
        run.run_id,
        truth["keyframe_id"],
        truth["room"],
        {"x": pose.x, "y": pose.y, "yaw_rad": pose.yaw_rad},
        tuple(asked),
        everywhere,
    )


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
    reader: CandidateReader, run: SimulatedRun, index: int, crops: Sequence[dict[str, Any]]
) -> AskedQuestion:
    started = time.monotonic()
    question = read_question({"crops": crops})
    answer = rank(question, reader.candidates(question.crops))
    seconds = time.monotonic() - started
    true, pose = run.true_poses[index], answer.pose
    error = None if pose is None else math.dist((pose.x, pose.y), (true.x, true.y))
    return AskedQuestion(tuple(d["class"] for d in crops), answer, error, seconds)


def _ask_whole_run(reader: CandidateReader, run: SimulatedRun) -> RunSummary:
    started = time.monotonic()
    asked = [
        _ask(reader, run, index, _most_confident(envelope))
        for index, envelope in enumerate(run.envelopes)
        if envelope["detections"]
    ]
    known = [a.error_m for a in asked if a.error_m is not None and not a.answer.unknown]
    return RunSummary(
        asked=len(asked),
        unknown=len(asked) - len(known),
        near=sum(error <= NEAR_M for error in known),
        median_error_m=statistics.median(known) if known else math.nan,
        seconds=time.monotonic() - started,
    )
