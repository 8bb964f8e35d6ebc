"""Runs through a small room with things that stand somewhere, seen through a camera.

Not a measure of how good a map is: labels flicker, looks are noisy, boxes are cut, robots get lost
and things are carried elsewhere, so that a few keyframes meet every branch of fusion by evidence.

Settings of drives with fusion by evidence, and recounts of their maps.
"""

import base64
import copy
import math
import random
from collections import Counter
from typing import Any, Literal

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from eventsrc.envelope.commands import Command
from eventsrc.envelope.model import Offset
from projections.fold import deltas as d
from projections.fold.corrections import Corrections, RecordedCommand, compile_corrections
from projections.fold.settings import Settings
from projections.map.view import MapView
from tests.support.envelopes import detection, envelope
from tests.support.folds import Folded, recounted_adjacency, recounted_places
from tests.support.thorough import examples

CLASSES = ("cup", "chair", "lamp")
DIM = 6
_WIDTH, _HEIGHT, _HFOV = 640.0, 400.0, 69.4
_FOCAL = _WIDTH / 2 / math.tan(math.radians(_HFOV) / 2)


class Room:
    """Things of a room; `keyframe` is what a robot sees from a pose."""

    def __init__(self, seed: int, things: int) -> None:
        self.rng = random.Random(seed)
        self.things = [
            (
                self.rng.choice(CLASSES),
                [self.rng.gauss(0, 1) + 0.6 for _ in range(DIM)],
                [self.rng.uniform(0, 5), self.rng.uniform(0, 4)],
            )
            for _ in range(things)
        ]

    def carry(self) -> None:
        """A thing is somewhere else."""
        if self.things:
            self.rng.choice(self.things)[2][:] = [self.rng.uniform(0, 5), self.rng.uniform(0, 4)]

    def keyframe(self, number: int, run: str) -> dict[str, Any]:
        """An envelope; some have no pose, a camera of their own, depths, positions, odd labels."""
        rng = self.rng
        x, y, yaw = rng.uniform(0, 5), rng.uniform(0, 4), rng.uniform(-7, 7)
        seen = []
        for name, look, (tx, ty) in self.things:
            bearing = math.remainder(math.atan2(ty - y, tx - x) - yaw, 2 * math.pi)
            distance = math.hypot(tx - x, ty - y)
            if abs(bearing) > math.radians(_HFOV) / 2 or distance < 0.3:
                continue
            centre = _WIDTH / 2 - _FOCAL * math.tan(bearing)
            half = _FOCAL * 0.2 / distance
            box = [centre - half, 200 - half, centre + half, 200 + half]
            fields: dict[str, Any] = {}
            if rng.random() < 0.15:
                fields["depth_m"] = distance
                if rng.random() < 0.5:
                    fields["depth_sigma_m"] = 0.2
            if rng.random() < 0.1:
                fields |= {"position": [tx, ty], "position_z": x - 2.0, "size": [0.3, 0.2, y + 0.1]}
            vector = None if rng.random() < 0.05 else [v + rng.gauss(0, 0.2) for v in look]
            label = rng.choice(CLASSES) if rng.random() < 0.15 else name
            clipped = [min(max(v, 0.0), m) for v, m in zip(box, (640, 400) * 2, strict=True)]
            seen.append(detection(label, vector, bbox=clipped, **fields))
        more: dict[str, Any] = {"map_yaw": yaw} if rng.random() > 0.08 else {}
        if rng.random() < 0.1:
            more["camera"] = {"hfov_deg": 80.0, "width_px": 640.0, "height_px": 400.0}
        if number % 30 == 3:
            more["scan"] = {"angle_min": 0.0, "angle_step": 0.2, "range_max": 9.0}
            more["scan"]["ranges_mm"] = base64.b64encode(bytes(range(8, 68))).decode()
        posed = x if "map_yaw" in more else None
        return envelope(number, posed, y, run_id=run, detections=seen, **more)


def drive(seed: int, count: int, things: int = 6) -> list[dict[str, Any]]:
    """Keyframes of two runs; between them a thing is carried elsewhere; some come twice."""
    room = Room(seed, things)
    documents = []
    for number in range(count):
        if number == count // 2:
            room.carry()
        documents.append(room.keyframe(number, "run-a" if number < count // 2 else "run-b"))
        if room.rng.random() < 0.05:
            documents.append(room.rng.choice(documents))
    return documents


def long_drive(seed: int, runs: int = 3, each: int = 80) -> list[dict[str, Any]]:
    """Keyframes of several runs, and two things carried elsewhere before each but the first."""
    room = Room(seed, 8)
    documents = []
    for run in range(runs):
        if run:
            room.carry()
            room.carry()
        numbers = range(each * run, each * (run + 1))
        documents += [room.keyframe(number, f"run-{run}") for number in numbers]
    return documents


@st.composite
def drives(draw: st.DrawFn, most: int = 30) -> list[dict[str, Any]]:
    """`drive` of any length and seed, by a detector with embeddings, without, or at times; with
    range scans or without."""
    seed, things = draw(st.integers(0, 2**32)), draw(st.integers(0, 7))
    documents = drive(seed, draw(st.integers(0, most)), things)
    if not draw(st.booleans()):
        documents = [{**document, "scan": None} for document in documents]
    return without_embeddings(documents, draw(st.sampled_from(WITHOUT)))


Without = Literal["", "none", "late", "half"]
WITHOUT: tuple[Without, ...] = ("", "", "none", "late", "half")
"""Which embeddings are left out: no more than a drive leaves out, all, those of its first half, and
of every second detection."""


def without_embeddings(documents: list[dict[str, Any]], which: Without) -> list[dict[str, Any]]:
    """The same drive seen by another detector."""
    left_out = copy.deepcopy(documents)
    for number, document in enumerate(left_out):
        for index, seen in enumerate(document["detections"]):
            if (
                which == "none"
                or (which == "late" and number < len(documents) // 2)
                or (which == "half" and (index + document["keyframe_id"]) % 2)
            ):
                for name in ("embedding", "embedding_dim", "embedding_model"):
                    seen.pop(name, None)
    return left_out


EVIDENCE = Settings(fusion="evidence", eps_m=1.0)
SLOW = settings(
    deadline=None,
    max_examples=examples(40),
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)


def recounted_votes(view: MapView, deltas: list[d.Delta]) -> list[int | None]:
    """The place of each Object, from the keyframes that saw it since its last relocation."""
    votes: dict[int, list[int]] = {}
    for delta, following in zip(deltas, [*deltas, None][1:], strict=True):
        if isinstance(delta, d.ObjectSeen):
            keyframe = view.observations[delta.observation].keyframe
            votes.setdefault(delta.object, []).append(keyframe)
        elif isinstance(delta, d.ObjectsMerged):
            if isinstance(following, d.ObjectRelocated):
                votes[delta.survivor] = []
            votes[delta.survivor] += votes.pop(delta.absorbed)
    located: list[int | None] = []
    for ordinal in view.objects:
        cast = Counter(view.keyframes[keyframe].place for keyframe in votes[ordinal])
        del cast[None]
        located.append(min(cast, key=lambda p: (-cast[p], p or 0), default=None))
    return located


def check_recounts(folded: Folded, same: bool = False) -> None:
    """Check the numbers of each Object against a recount from its observations."""
    view, deltas = folded.view, [delta for each in folded.deltas for delta in each]
    seen_beside = {  # what a few pictures showed as two may still be one
        view.object_survivors.find(delta.survivor)
        for delta in deltas
        if isinstance(delta, d.ObjectsMerged)
        and delta.evidence
        and delta.evidence.pictures_with_both
    }
    assert view.adjacency == recounted_adjacency(view)
    if not view.maps:  # else those of a region are in its place
        assert [found.place for found in view.objects.values()] == recounted_votes(view, deltas)
    assert {
        p.ordinal: (p.keyframe_count, p.sum_x_um, p.sum_y_um) for p in view.places.values()
    } == recounted_places(view)
    for found in view.objects.values():
        seen = [view.observations[number] for number in found.observations]
        keyframes = [view.keyframes[each.keyframe] for each in seen]
        assert found.observations == sorted(found.observations)
        assert all(each.object == found.ordinal for each in seen)
        assert found.obs_count == len(seen)
        poses = [k.pose for k in keyframes if k.pose is not None]
        assert found.sum_x_um == sum(pose.x_um for pose in poses)
        assert found.sum_y_um == sum(pose.y_um for pose in poses)
        times = [k.timestamp for k in keyframes]
        assert (found.first_seen, found.last_seen) == (min(times), max(times))
        votes = Counter(each.class_name for each in seen)
        assert votes[found.class_name] == max(votes.values())
        assert votes == view.class_counts(found)
        if not same and found.ordinal not in seen_beside:
            assert len({each.keyframe for each in seen}) == len(seen), "two of one picture"
        at = found.estimate
        assert at is not None
        assert at.spots >= 1
        assert at.var_xx_um2 > 0
        assert at.var_yy_um2 > 0
        assert at.var_xx_um2 * at.var_yy_um2 >= at.var_xy_um2**2


def compiled(*commands: Command) -> Corrections:
    """Corrections by these commands, recorded one after the other."""
    return compile_corrections(RecordedCommand(Offset(n), c) for n, c in enumerate(commands))


def det_ids(documents: list[dict[str, Any]]) -> list[str]:
    """Those that can be of an Object, each once."""
    named = (
        f"{e['run_id']}_kf{e['keyframe_id']}_d{i}"
        for e in documents
        for i in range(len(e["detections"]))
        if e.get("map_x") is not None
    )
    return list(dict.fromkeys(named))
