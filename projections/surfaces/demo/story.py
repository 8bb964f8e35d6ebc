"""The demo's report: a few lines for each stage, and all its numbers as one JSON document.

Lengths in metres, times in seconds.
"""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from textwrap import wrap
from typing import Any

from eventsrc.base.text import counted
from projections.fold.settings import Settings
from projections.localize.relocalize import UNKNOWN_BELOW
from projections.postgres import RebuildReport
from projections.postgres.labels import EDGE_LABELS, TABLE, VERTEX_LABELS
from projections.surfaces.python import Map

from .acts import (
    NEAR_M,
    AskedQuestion,
    Corrected,
    Explored,
    LostRun,
    RoomMerge,
    RoomPart,
    most_telling,
)
from .recorded_run import Followed, RecordedRun


def recording_lines(
    recorded: RecordedRun, followed: Followed, detections: int, rooms: int, speed: float
) -> Iterator[str]:
    """How run A was recorded, and tailed into the databases."""
    kept = "byte for byte" if recorded.intact else "NOT byte for byte"
    yield (
        f"   {recorded.run_id} drove {recorded.drive_seconds:.0f} s through "
        f"{counted(rooms, 'room')}, played "
        f"{speed:g} times as fast, over a Zenoh router to"
    )
    yield (
        f"   `mapfold record` in another process: {recorded.recorded} of {recorded.published} "
        f"keyframes with {counted(detections, 'detection')} are in the log,"
    )
    yield (
        f"   {kept}; {recorded.rejected} rejected, {recorded.lost} lost, "
        f"{recorded.log_bytes / 1e6:.1f} MB"
    )
    yield "   the log began with its settings, the preset full, and the walls of the house"
    yield (
        f"   a tail wrote them to Apache AGE and pgvector as they came, in "
        f"{counted(followed.batches, 'transaction')}:"
    )
    yield (
        f"   {1000 * followed.median_delay_s:.0f} ms (median) after it was recorded an event could "
        f"be queried, after {1000 * followed.worst_delay_s:.0f} ms at worst"
    )


def replay_lines(replayed: RebuildReport, house: Map, same_rows: bool) -> Iterator[str]:
    """Whether a replay gives the same rows and digest."""
    nodes = sum(replayed.rows[label] for label in VERTEX_LABELS)
    edges = sum(replayed.rows[label] for label in EDGE_LABELS)
    rows = "the same rows as" if same_rows else "OTHER rows than"
    yield (
        f"   rebuilt from the log in {replayed.total_s:.2f} s: "
        f"{counted(nodes, 'node')}, {counted(edges, 'edge')}, "
        f"{counted(replayed.rows[TABLE], 'vector')};"
    )
    yield f"   {rows} the tail wrote, {_digest_text(replayed, house, 16)}"


def _digest_text(replayed: RebuildReport, house: Map, shown: int) -> str:
    digest = "the same digest as" if replayed.digest == house.digest else "ANOTHER digest than"
    return f"{digest} a fold without databases: {house.digest[:shown]}…"


def map_lines(house: Map, other_settings: Settings, other_places: int) -> Iterator[str]:
    """The map's numbers, with which settings, and with the classic ones."""
    counts = house.state["counts"]
    yield (
        f"   {counted(counts['places'], 'place')} from {counted(counts['keyframes'], 'keyframe')} "
        f"({counts['noise']} in none), {counted(counts['objects'], 'object')} from "
        f"{counted(counts['observations'], 'observation')},"
    )
    transitions = counted(_transitions(house), "transition")
    pairs = counted(counts["adjacency"], "pair")
    yield (
        f"   {transitions} between {pairs} of neighbouring places; "
        f"{house.view.settings.places_text()}"
    )
    yield (
        f"   (classic, by distance alone, {other_settings.eps_m:g} m and "
        f"{other_settings.min_samples}, chains this drive into {counted(other_places, 'place')})"
    )


def _transitions(house: Map) -> int:
    return sum(pair["shared_transitions"] for pair in house.adjacency)


def type_lines(house: Map) -> Iterator[str]:
    """The likely types of the places."""
    typed = [
        f"{_short(place['place_id'])} {place['type']} {100 * place['type_probability']:.0f} %"
        for place in house.places
        if place.get("type") is not None
    ]
    if typed:
        unsure = len(house.places) - len(typed)
        text = f"by what stands in them ({unsure} unsure): {', '.join(typed)}"
        yield from wrap(text, 96, initial_indent="   ", subsequent_indent="   ")


def merge_lines(merges: tuple[RoomMerge, ...]) -> Iterator[str]:
    """The most telling merge of places."""
    merge = most_telling(merges)
    if merge is None:
        yield "   no two places became one on this drive"
        return
    parts = " and ".join(map(_part, (merge.survivor, *merge.absorbed)))
    more = f"; {len(merges)} such moments on this drive" if len(merges) > 1 else ""
    after = merge.places_before - len(merge.absorbed)
    yield f"   and how two places became one: {parts}"
    yield (
        f"   were bridged by keyframe {merge.keyframe_id} in the {merge.bridge_room}, event "
        f"{merge.offset} of the log, and are {_short(merge.survivor.place_id)} since,"
    )
    yield (
        f"   because it was founded first ({counted(merge.places_before, 'place')} before, "
        f"{after} after{more})"
    )


def correction_lines(corrected: Corrected) -> Iterator[str]:
    """The correction, and the map under it."""
    offsets = {command["kind"]: command["offset"] for command in corrected.commands}
    places = counted(len(corrected.house.places), "place")
    if corrected.apart:
        parts = " and ".join(map(_part, corrected.apart))
        yield (
            f"   that merge is undone by a command, event {offsets['undo-merge']} of the log: "
            f"{places} now, among them"
        )
        yield f"   {parts};"
    if (named := corrected.named) is not None:
        yield (
            f'   {_short(named.place_id)} is called "{named.room}" in graph, answers and picture, '
            f"by another command, event {offsets['name-place']};"
        )
    yield (
        f"   rebuilt from the log in {corrected.replayed.total_s:.2f} s, "
        f"{_digest_text(corrected.replayed, corrected.house, 8)}"
    )


def question_lines(lost: LostRun, rooms: dict[str, str]) -> Iterator[str]:
    """Run B's questions and the answers."""
    yield (
        f"   {lost.run_id}, another day, looks around and does not know where it is (in the "
        f"{lost.room}, in truth)"
    )
    for asked in lost.questions:
        yield f"   {counted(len(asked.classes), 'crop')} ({', '.join(asked.classes)})"
        yield f"     → {_places(asked, rooms)}"
        yield f"       {_pose(asked)}"
    every = lost.everywhere
    yield (
        f"   asked once from each of its {counted(every.asked, 'keyframe')} that show something: "
        f"{counted(every.near, 'answer')} within {NEAR_M:g} m,"
    )
    yield (
        f'   {every.unknown} "unknown", {every.asked - every.unknown - every.near} wrong; '
        f"median error {every.median_error_m:.2f} m where it answered, "
        f"{1000 * every.seconds / max(1, every.asked):.0f} ms a question"
    )


def _places(asked: AskedQuestion, rooms: dict[str, str]) -> str:
    return ", ".join(
        f"{_short(place.place_id)} {place.score:.2f} ({rooms.get(place.place_id, '?')})"
        for place in asked.answer.places
        if place.score >= 0.005
    )


def _pose(asked: AskedQuestion) -> str:
    answer = asked.answer
    off = "no pose" if asked.error_m is None else f"{asked.error_m:.2f} m off"
    sure = f"confidence {answer.confidence:.2f}"
    if answer.unknown:
        sure += f", known {answer.known:.2f}, below {UNKNOWN_BELOW:g}: unknown"
    return f"pose {off}, {sure}, {1000 * asked.seconds:.0f} ms"


def _part(part: RoomPart) -> str:
    return f"{_short(part.place_id)} ({counted(part.keyframes, 'keyframe')}, {part.room})"


def _short(place_id: str) -> str:
    return place_id.rpartition("_")[2]


@dataclass(frozen=True, slots=True)
class DemoResult:
    """The results of the stages. ``same_rows``: the replay wrote the rows that the tail had."""

    seed: int
    settings: Settings
    recorded: RecordedRun
    followed: Followed
    replayed: RebuildReport
    same_rows: bool
    explored: Explored
    corrected: Corrected
    lost: LostRun

    @property
    def sound(self) -> bool:
        """Whether log and run, tail and replay, databases and fold agree."""
        recorded = self.recorded
        whole = recorded.intact and not recorded.rejected and not recorded.lost
        same_digest = self.replayed.digest == self.explored.house.digest
        return whole and self.same_rows and same_digest and self.corrected.same_digest


def result_document(result: DemoResult, seconds: dict[str, float], folder: Path) -> dict[str, Any]:
    """The output of ``mapfold demo --json``; ``seconds`` by stage."""
    house, replayed = result.explored.house, result.replayed
    corrected, lost = result.corrected, result.lost
    counts = house.state["counts"]
    return {
        "sound": result.sound,
        "seed": result.seed,
        "settings": result.settings.model_dump(),
        "record": asdict(result.recorded),
        "tail": asdict(result.followed),
        "replay": {
            "rows": replayed.rows,
            "same_rows_as_tail": result.same_rows,
            "digest": replayed.digest,
            "seconds": replayed.total_s,
        },
        "map": {
            "keyframes": counts["keyframes"],
            "places": counts["places"],
            "objects": counts["objects"],
            "adjacent_pairs": counts["adjacency"],
            "transitions": _transitions(house),
            "digest": house.digest,
            "fold_seconds": result.explored.seconds,
        },
        "merges": [asdict(merge) for merge in result.explored.merges],
        "corrected": {
            "commands": list(corrected.commands),
            "named": None if corrected.named is None else asdict(corrected.named),
            "apart": [asdict(part) for part in corrected.apart],
            "places": len(corrected.house.places),
            "digest": corrected.house.digest,
            "seconds": corrected.seconds,
        },
        "relocalize": {
            "run_id": lost.run_id,
            "keyframe_id": lost.keyframe_id,
            "room": lost.room,
            "truth": lost.truth,
            "questions": [
                {
                    "classes": list(asked.classes),
                    "error_m": asked.error_m,
                    "seconds": asked.seconds,
                    **asked.answer.document(),
                }
                for asked in lost.questions
            ],
            "everywhere": asdict(lost.everywhere),
        },
        "seconds": {**seconds, "total": sum(seconds.values())},
        "files": {
            "folder": str(folder),
            "log": str(folder / "log"),
            "map": str(folder / "map.png"),
        },
    }
