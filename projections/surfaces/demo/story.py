"""The demo's report in lines, from the numbers that ``--json`` prints. Metres and seconds."""

from collections.abc import Iterator, Mapping, Sequence
from textwrap import wrap
from typing import Any, TypeAlias

from eventsrc.base.text import counted
from projections.fold.settings import Settings
from projections.localize.relocalize import UNKNOWN_BELOW
from projections.postgres.labels import EDGE_LABELS, TABLE, VERTEX_LABELS
from projections.surfaces.python import Map

Numbers: TypeAlias = Mapping[str, Any]
NEAR_M = 1.5
"""Error up to which an estimate counts as right; the answer's ``confidence`` has the same bound."""


def recording_lines(
    recorded: Numbers, tailed: Numbers, detections: int, rooms: int, speed: float
) -> Iterator[str]:
    """How run A was recorded, and tailed into the databases."""
    kept = "byte for byte" if recorded["intact"] else "NOT byte for byte"
    yield (
        f"{recorded['run_id']} drove {recorded['drive_seconds']:.0f} s through "
        f"{counted(rooms, 'room')}, played {speed:g} times as fast, over a Zenoh router to"
    )
    yield (
        f"`mapfold record` in another process: {recorded['recorded']} of {recorded['published']} "
        f"keyframes with {counted(detections, 'detection')} are in the log,"
    )
    yield (
        f"{kept}; {recorded['rejected']} rejected, {recorded['lost']} lost, "
        f"{recorded['log_bytes'] / 1e6:.1f} MB"
    )
    yield "the log began with its settings, the preset full, and the walls of the house"
    yield (
        "a tail wrote them to Apache AGE and pgvector as they came, in "
        f"{counted(tailed['batches'], 'transaction')}:"
    )
    yield (
        f"{1000 * tailed['median_delay_s']:.0f} ms (median) after it was recorded an event could "
        f"be queried, after {1000 * tailed['worst_delay_s']:.0f} ms at worst"
    )


def replay_lines(replayed: Numbers, digest: str) -> Iterator[str]:
    """Whether a replay gives the same rows, and the digest of the fold."""
    rows = replayed["rows"]
    nodes, edges = (sum(map(rows.__getitem__, each)) for each in (VERTEX_LABELS, EDGE_LABELS))
    same = "the same rows as" if replayed["same_rows_as_tail"] else "OTHER rows than"
    yield (
        f"rebuilt from the log in {replayed['seconds']:.2f} s: {counted(nodes, 'node')}, "
        f"{counted(edges, 'edge')}, {counted(rows[TABLE], 'vector')};"
    )
    yield f"{same} the tail wrote, {_digest_text(replayed['digest'], digest, 16)}"


def _digest_text(replayed: str, folded: str, shown: int) -> str:
    digest = "the same digest as" if replayed == folded else "ANOTHER digest than"
    return f"{digest} a fold without databases: {folded[:shown]}…"


def map_lines(house: Map, other_settings: Settings, other_places: int) -> Iterator[str]:
    """The map's numbers, with which settings, and with the classic ones."""
    counts = house.state["counts"]
    yield (
        f"{counted(counts['places'], 'place')} from {counted(counts['keyframes'], 'keyframe')} "
        f"({counts['noise']} in none), {counted(counts['objects'], 'object')} from "
        f"{counted(counts['observations'], 'observation')},"
    )
    yield (
        f"{counted(transitions(house), 'transition')} between "
        f"{counted(counts['adjacency'], 'pair')} of neighbouring places; "
        f"{house.view.settings.places_text()}"
    )
    yield (
        f"(classic, by distance alone, {other_settings.eps_m:g} m and "
        f"{other_settings.min_samples}, chains this drive into {counted(other_places, 'place')})"
    )


def transitions(house: Map) -> int:
    """How often the robot went from one place into another."""
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
        yield from wrap(f"by what stands in them ({unsure} unsure): {', '.join(typed)}", 93)


def most_telling(merges: Sequence[Numbers]) -> Numbers | None:
    """The merge to describe: of different rooms if there is one, with the largest small part."""

    def told(merge: Numbers) -> tuple[bool, int, int]:
        smallest = min(part["keyframes"] for part in parts_of(merge))
        return across_rooms(merge), smallest, -merge["offset"]

    return max(merges, key=told, default=None)


def across_rooms(merge: Numbers) -> bool:
    """Whether the parts of a merge were of different rooms."""
    return len({part["room"] for part in parts_of(merge)}) > 1


def parts_of(merge: Numbers) -> list[Numbers]:
    """The places that a merge made one, the survivor first."""
    return [merge["survivor"], *merge["absorbed"]]


def merge_lines(merges: Sequence[Numbers]) -> Iterator[str]:
    """The most telling merge of places."""
    merge = most_telling(merges)
    if merge is None:
        yield "no two places became one on this drive"
        return
    more = f"; {len(merges)} such moments on this drive" if len(merges) > 1 else ""
    before = merge["places_before"]
    yield f"and how two places became one: {_parts_text(parts_of(merge))}"
    yield (
        f"were bridged by keyframe {merge['keyframe_id']} in the {merge['bridge_room']}, event "
        f"{merge['offset']} of the log, and are {_short(merge['survivor']['place_id'])} since,"
    )
    yield (
        f"because it was founded first ({counted(before, 'place')} before, "
        f"{before - len(merge['absorbed'])} after{more})"
    )


def correction_lines(corrected: Numbers) -> Iterator[str]:
    """The correction, and the map under it."""
    offsets = {command["kind"]: command["offset"] for command in corrected["commands"]}
    if corrected["apart"]:
        places = counted(corrected["places"], "place")
        yield (
            f"that merge is undone by a command, event {offsets['undo-merge']} of the log: "
            f"{places} now, among them"
        )
        yield f"{_parts_text(corrected['apart'])};"
    if (named := corrected["named"]) is not None:
        yield (
            f'{_short(named["place_id"])} is called "{named["room"]}" in graph, answers and '
            f"picture, by another command, event {offsets['name-place']};"
        )
    yield (
        f"rebuilt from the log in {corrected['replay_seconds']:.2f} s, "
        f"{_digest_text(corrected['replay_digest'], corrected['digest'], 8)}"
    )


def question_lines(lost: Numbers, rooms: Mapping[str, str]) -> Iterator[str]:
    """Run B's questions and the answers; ``rooms`` by place."""
    yield (
        f"{lost['run_id']}, another day, looks around and does not know where it is (in the "
        f"{lost['room']}, in truth)"
    )
    for asked in lost["questions"]:
        places = ", ".join(
            f"{_short(each['place_id'])} {each['score']:.2f} ({rooms.get(each['place_id'], '?')})"
            for each in asked["places"]
            if each["score"] >= 0.005
        )
        off = "no pose" if asked["error_m"] is None else f"{asked['error_m']:.2f} m off"
        sure = f"confidence {asked['confidence']:.2f}"
        if asked["unknown"]:
            sure += f", known {asked['known']:.2f}, below {UNKNOWN_BELOW:g}: unknown"
        yield f"{counted(len(asked['classes']), 'crop')} ({', '.join(asked['classes'])})"
        yield f"  → {places}"
        yield f"    pose {off}, {sure}, {1000 * asked['seconds']:.0f} ms"
    every = lost["everywhere"]
    yield (
        f"asked once from each of its {counted(every['asked'], 'keyframe')} that show something: "
        f"{counted(every['near'], 'answer')} within {NEAR_M:g} m,"
    )
    yield (
        f'{every["unknown"]} "unknown", {every["asked"] - every["unknown"] - every["near"]} wrong; '
        f"median error {every['median_error_m']:.2f} m where it answered, "
        f"{1000 * every['seconds'] / max(1, every['asked']):.0f} ms a question"
    )


def _parts_text(parts: Sequence[Numbers]) -> str:
    return " and ".join(
        f"{_short(part['place_id'])} ({counted(part['keyframes'], 'keyframe')}, {part['room']})"
        for part in parts
    )


def _short(place_id: str) -> str:
    return place_id.rpartition("_")[2]


def is_sound(numbers: Numbers) -> bool:
    """Whether log and run, tail and replay, databases and fold agree."""
    recorded, replayed, corrected = (numbers[key] for key in ("record", "replay", "corrected"))
    whole = recorded["intact"] and not recorded["rejected"] and not recorded["lost"]
    same_digest = replayed["digest"] == numbers["map"]["digest"]
    same_after = corrected["replay_digest"] == corrected["digest"]
    return bool(whole and replayed["same_rows_as_tail"] and same_digest and same_after)
