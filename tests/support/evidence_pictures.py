"""Pictures of a small made-up room, for tests of fusion by evidence."""

import math
from typing import NamedTuple

import numpy as np

from eventsrc.envelope.model import DetId, Offset
from projections.fold.deltas import ObservationOrdinal, Pose, RunOrdinal
from projections.fold.evidence import EvidenceConstants
from projections.fold.evidence_objects import EvidenceObjects, ObjectDelta
from projections.fold.exact import metres_to_um, unit_vectors
from projections.fold.objects import NO_VECTOR
from projections.fold.pair_groups import PairGroups
from projections.fold.settings import CameraConstants
from projections.fold.sights import Sighting

CAMERA = CameraConstants(hfov_deg=70.0, width_px=640.0, height_px=400.0)
FOCAL = CAMERA.width_px / 2 / math.tan(math.radians(CAMERA.hfov_deg / 2))
DIM = 48
CLASSES = ("chair", "table", "plant")


class Picture(NamedTuple):
    """One call of `EvidenceObjects.fold`, and the true thing of each sighting."""

    offset: Offset
    run: RunOrdinal
    timestamp: float
    pose: Pose
    sightings: list[Sighting]
    things: list[int]


class Stuff(NamedTuple):
    """A thing of the room: class, position, height, height of its centre above the camera."""

    class_name: str
    x: float
    y: float
    height: float
    elevation: float


def a_room(seed: int, count: int = 8, side: float = 5.0) -> list[Stuff]:
    """Things at random positions."""
    chance = np.random.default_rng(seed)
    return [
        Stuff(
            CLASSES[int(chance.integers(len(CLASSES)))],
            float(chance.uniform(0, side)),
            float(chance.uniform(0, side)),
            float(chance.uniform(0.2, 1.0)),
            float(chance.uniform(-0.8, 0.4)),
        )
        for _ in range(count)
    ]


def pictures_of(
    room: list[Stuff],
    seed: int,
    count: int = 60,
    runs: int = 2,
    side: float = 5.0,
    bare: float = 0.0,
) -> list[Picture]:
    """Pictures from random poses in the room; a ``bare`` share of sightings has no embedding."""
    chance, bares = np.random.default_rng(seed), np.random.default_rng(seed)
    base = chance.normal(size=DIM) * 0.7
    of_class = {name: chance.normal(size=DIM) * 0.5 for name in CLASSES}
    of_thing = [chance.normal(size=DIM) * 0.3 for _ in room]
    pictures = []
    observation = 0
    for number in range(count):
        x, y, yaw = chance.uniform(0, side), chance.uniform(0, side), chance.uniform(-9, 9)
        pose = Pose(metres_to_um(float(x)), metres_to_um(float(y)), float(yaw))
        sightings: list[Sighting] = []
        things: list[int] = []
        for index, thing in enumerate(room):
            dx, dy = thing.x - x, thing.y - y
            ahead = dx * math.cos(yaw) + dy * math.sin(yaw)
            aside = dy * math.cos(yaw) - dx * math.sin(yaw)
            if ahead < 0.5 or abs(aside) > 0.6 * ahead or chance.random() < 0.2:
                continue
            u = CAMERA.width_px / 2 - FOCAL * aside / ahead + chance.normal() * 4
            v = CAMERA.height_px / 2 - FOCAL * thing.elevation / ahead + chance.normal() * 4
            half = FOCAL * thing.height / ahead / 2
            bbox = (
                min(max(u - half, 0.0), 630.0),
                min(max(v - half, 0.0), 390.0),
                max(min(u + half, 640.0), min(max(u - half, 0.0), 630.0) + 1.0),
                max(min(v + half, 400.0), min(max(v - half, 0.0), 390.0) + 1.0),
            )
            vector = base + of_class[thing.class_name] + of_thing[index]
            vector = vector + chance.normal(size=DIM) * 0.15
            is_flicker = chance.random() < 0.05
            label = CLASSES[0] if is_flicker else thing.class_name
            looked = a_sighting(observation, label, vector, bbox)
            is_bare = bares.random() < bare
            sightings.append(looked._replace(vector=NO_VECTOR, norm2=0) if is_bare else looked)
            things.append(index)
            observation += 1
        run = RunOrdinal(number * runs // count)
        pictures.append(Picture(Offset(number + 1), run, number * 0.5, pose, sightings, things))
    return pictures


def a_sighting(
    observation: int, label: str, vector: object, bbox: tuple[float, float, float, float]
) -> Sighting:
    """A sighting of that look; its det_id is ``d`` and the ordinal."""
    unit = unit_vectors([np.asarray(vector, np.float32)])[0]
    assert unit is not None
    det_id = DetId(f"d{observation}")
    return Sighting(ObservationOrdinal(observation), det_id, label, unit[0], unit[2], bbox)


def fold_all(pictures: list[Picture], groups: PairGroups[DetId] | None = None) -> list[ObjectDelta]:
    """The deltas of all pictures."""
    objects = EvidenceObjects(EvidenceConstants(), groups)
    return [delta for picture in pictures for delta in fold_one(objects, picture)]


def fold_one(objects: EvidenceObjects, picture: Picture) -> list[ObjectDelta]:
    """The deltas of one picture."""
    offset, run, timestamp, pose, sightings, _ = picture
    return objects.fold(offset, run, timestamp, pose, CAMERA, sightings)
