"""The demo's story for people: a few short lines a stage, every number from what has happened."""

from collections.abc import Iterator

from projections.relocalize import UNKNOWN_BELOW
from projections.runner import RebuildReport
from projections.settings import Settings
from projections.sinks.labels import EDGE_LABELS, TABLE, VERTEX_LABELS

from .asking import NEAR_M, Asked, Lost
from .mapping import Folded, MergeMoment, Part, most_telling
from .recording import Recorded


def tell_recording(recorded: Recorded, detections: int, rooms: int, speed: float) -> Iterator[str]:
    """How run A got into the log."""
    kept = "byte for byte" if recorded.intact else "NOT byte for byte"
    yield (
        f"   {recorded.run_id} drove {recorded.drive_seconds:.0f} s through {rooms} rooms, played "
        f"{speed:g} times as fast, over a Zenoh router to"
    )
    yield (
        f"   `mapfold record` in another process: {recorded.recorded} of {recorded.published} "
        f"keyframes with {detections} detections are in the log,"
    )
    yield (
        f"   {kept}; {recorded.rejected} rejected, {recorded.lost} lost, "
        f"{recorded.log_bytes / 1e6:.1f} MB"
    )


def tell_map(
    folded: Folded, replayed: RebuildReport, other_settings: Settings, other_places: int
) -> Iterator[str]:
    """What the log became, and honestly with which settings."""
    counts, settings = folded.view.counts(), folded.view.settings
    transitions = sum(count for _, _, count in folded.view.edges())
    nodes = sum(replayed.rows[label] for label in VERTEX_LABELS)
    edges = sum(replayed.rows[label] for label in EDGE_LABELS)
    yield (
        f"   {counts['places']} places from {counts['keyframes']} keyframes ({counts['noise']} in "
        f"none), {counts['objects']} objects from {counts['observations']} observations,"
    )
    yield (
        f"   {transitions} transitions between {counts['adjacency']} pairs of neighbouring places; "
        f"settings ε {settings.eps_m:g} m, min_samples {settings.min_samples}"
    )
    yield (
        f"   (the default, {other_settings.eps_m:g} m and {other_settings.min_samples}, chains "
        f"this drive into {_count(other_places, 'place')})"
    )
    yield (
        f"   written in {replayed.total_s:.2f} s: {nodes} nodes and {edges} edges in Apache AGE, "
        f"{replayed.rows[TABLE]} vectors in pgvector"
    )
    same = "the same digest" if replayed.digest == folded.digest else "ANOTHER digest"
    yield (
        f"   folded once more, without a database, in {folded.seconds:.2f} s: {same}, "
        f"{folded.digest[:16]}…"
    )


def tell_merges(merges: tuple[MergeMoment, ...]) -> Iterator[str]:
    """The moment two places became one, told for the most telling of them."""
    merge = most_telling(merges)
    if merge is None:
        yield "   no two places became one on this drive"
        return
    parts = " and ".join(map(_part, (merge.survivor, *merge.absorbed)))
    after = merge.places_before - len(merge.absorbed)
    yield (
        f"   keyframe {merge.keyframe_id}, event {merge.offset} of the log, taken in the "
        f"{merge.bridge_room}, bridged"
    )
    yield f"   {parts}"
    yield (
        f"   all are {_short(merge.survivor.place_id)} from then on, because it was founded first: "
        f"{_count(merge.places_before, 'place')} before, {after} after"
    )
    if len(merges) > 1:
        yield f"   ({len(merges)} such moments on this drive, all on the picture)"


def tell_lost(lost: Lost, rooms: dict[str, str]) -> Iterator[str]:
    """Run B's questions and what came back."""
    yield (
        f"   {lost.run_id}, another day, looks around and does not know where it is (in the "
        f"{lost.room}, in truth)"
    )
    for asked in lost.questions:
        yield f"   {_count(len(asked.classes), 'crop')} ({', '.join(asked.classes)})"
        yield f"     → {_answer(asked, rooms)}"
    every = lost.everywhere
    yield (
        f"   asked once from each of its {every.asked} keyframes that show something: "
        f"{every.near} answers within {NEAR_M:g} m,"
    )
    yield (
        f'   {every.unknown} "unknown", {every.asked - every.unknown - every.near} wrong; '
        f"median error {every.median_error_m:.2f} m where it answered, "
        f"{1000 * every.seconds / max(1, every.asked):.0f} ms a question"
    )


def _answer(asked: Asked, rooms: dict[str, str]) -> str:
    answer = asked.answer
    places = ", ".join(
        f"{_short(place.place_id)} {place.score:.2f} ({rooms.get(place.place_id, '?')})"
        for place in answer.places
        if place.score >= 0.005
    )
    off = "no pose" if asked.error_m is None else f"{asked.error_m:.2f} m off"
    sure = f"confidence {answer.confidence:.2f}"
    if answer.unknown:
        sure += f", below {UNKNOWN_BELOW:g}: unknown"
    return f"{places}; pose {off}; {sure}; {1000 * asked.seconds:.0f} ms"


def _part(part: Part) -> str:
    return f"{_short(part.place_id)} ({_count(part.keyframes, 'keyframe')}, {part.room})"


def _short(place_id: str) -> str:
    return place_id.rpartition("_")[2]


def _count(number: int, thing: str) -> str:
    return f"{number} {thing}" if number == 1 else f"{number} {thing}s"
