"""A bag of ROS 2 of a generated run, imported as a user does without any option, against the truth:
the table of ``scripts/bench_truth --bags``.

``make_bag.py`` beside the generator writes the bag of run a: transforms, a map, CameraInfo,
detections of numbered classes, their names and embeddings.
"""

import json
import math
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from projections.localize.evaluate.scores import agreement
from projections.localize.evaluate.truth import Truth, read_truth
from projections.map.view import MapView
from projections.surfaces.python import fold

from .scoring import ObjectScores, majorities, score_objects
from .tables import number
from .worlds import NoWorldsError, read_case

_SAME_S = 0.05
"""A keyframe of a bag is the one with this stamp, more or less, of the run that it was made of."""


@dataclass(frozen=True, slots=True)
class BagRow:
    """A map of a bag. ``in_room`` of the ``confirmed`` Objects whose true room is known are in a
    place most of whose keyframes are in that room; of those in ``driven`` the robot was in the
    room."""

    name: str
    keyframes: int
    places: int
    rooms: int
    v_measure: float
    objects: ObjectScores
    confirmed: int
    driven: int
    in_room: int

    @property
    def in_room_share(self) -> float:
        """Of the Objects in rooms that the robot was in; NaN for none."""
        return self.in_room / self.driven if self.driven else math.nan


def bag_row(maker: Path, folder: Path, profile: str, world: str) -> BagRow:
    """Make a bag of run a of a case in ``folder``, import it, and score its map. Raises
    NoWorldsError where a step fails."""
    if not maker.exists():
        raise NoWorldsError(f"{maker} is absent; give its folder by --worlds DIR")
    with tempfile.TemporaryDirectory() as temporary:
        bag, log = Path(temporary, "bag"), Path(temporary, "log")
        _run([sys.executable, str(maker), str(folder), "a", str(bag), "--no-images"])
        _run([sys.executable, "-m", "projections.surfaces.cli", "import", str(log), str(bag)])
        view = fold(log, embeddings=False).view
    truth = _truth_of(view, read_truth([folder / f"{world}-a.truth.jsonl.gz"]), folder, world)
    rooms = {thing["id"]: thing["room"] for thing in _documents(folder / "objects.json")}
    things = read_case(folder, profile, world).things
    return score_bag(f"{profile} {world}", view, truth, rooms, score_objects(view, truth, things))


def score_bag(
    name: str, view: MapView, truth: Truth, rooms: dict[str, str | None], objects: ObjectScores
) -> BagRow:
    """The scores of a view; ``rooms`` has the room of each true thing."""
    known = [
        (room, keyframe.place)
        for keyframe in view.keyframes
        if (room := truth.room((keyframe.run_id, keyframe.keyframe_id))) is not None
    ]
    by_place: dict[int, Counter[str]] = {}
    for room, place in known:
        if place is not None:
            by_place.setdefault(place, Counter())[room] += 1
    room_of = {place: max(sorted(c), key=c.__getitem__) for place, c in by_place.items()}
    owners, was_in = majorities(view, truth), set(room_of.values())
    confirmed = [
        (found.place, room)
        for ordinal, found in view.objects.items()
        if found.confirmed and (room := rooms.get(owners.get(ordinal, ""))) is not None
    ]
    driven = [(place, room) for place, room in confirmed if room in was_in]
    return BagRow(
        name,
        len(view.keyframes),
        len(view.places),
        len({room for room, _ in known}),
        agreement([room for room, _ in known], [place for _, place in known]).v_measure,
        objects,
        len(confirmed),
        len(driven),
        sum(place is not None and room_of.get(place) == room for place, room in driven),
    )


def bags_table(rows: Sequence[BagRow]) -> str:
    """A line for each bag, the worst share of Objects in their room last, then the means."""
    heads = "kf", "places", "rooms", "V", "obj/true", "est p50", "confirm", "driven", "in room"
    lines = [_line("profile world", heads)]
    ordered = sorted(rows, key=lambda row: -row.in_room_share)
    for row in ordered:
        counts = row.keyframes, row.places, row.rooms
        scores = row.v_measure, row.objects.ratio, row.objects.median_error_m
        cells = [*map(str, counts), *(number(score, 3) for score in scores)]
        cells += [str(row.confirmed), str(row.driven), number(row.in_room_share, 3)]
        lines.append(_line(row.name, cells))
    if len(rows) > 1:
        errors = sorted(error for row in rows for error in row.objects.errors_m)
        means = (
            sum(row.v_measure for row in rows) / len(rows),
            sum(row.objects.ratio for row in rows) / len(rows),
            errors[len(errors) // 2] if errors else math.nan,
        )
        confirmed, driven = sum(row.confirmed for row in rows), sum(row.driven for row in rows)
        share = sum(row.in_room for row in rows) / driven if driven else math.nan
        cells = ["", "", "", *(number(mean, 3) for mean in means), str(confirmed), str(driven)]
        lines.append(_line("all", [*cells, number(share, 3)]))
    return "\n".join(lines)


def _line(name: str, cells: Sequence[str]) -> str:
    return name.ljust(26) + " ".join(cell.rjust(8) for cell in cells)


def _truth_of(view: MapView, truth: Truth, folder: Path, world: str) -> Truth:
    """The truth by the names that an import gave to run and keyframes; stamps are the same."""
    stamps = sorted(
        (accepted.envelope.timestamp, accepted.envelope.run_id, accepted.envelope.keyframe_id)
        for accepted in read_case(folder, "", world).events
        if accepted.envelope.run_id.endswith("-a")
    )
    found = {}
    for keyframe in view.keyframes:
        stamp, *key = min(stamps, key=lambda each: abs(each[0] - keyframe.timestamp))
        known = truth.keyframes.get((key[0], key[1]))
        if known is not None and abs(stamp - keyframe.timestamp) <= _SAME_S:
            own = {"run_id": keyframe.run_id, "keyframe_id": keyframe.keyframe_id}
            found[keyframe.run_id, keyframe.keyframe_id] = known.model_copy(update=own)
    return Truth(found)


def _documents(path: Path) -> list[dict[str, str | None]]:
    found: list[dict[str, str | None]] = json.loads(path.read_text())
    return found


def _run(command: list[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise NoWorldsError(f"{' '.join(command)} failed:\n{done.stderr}")
