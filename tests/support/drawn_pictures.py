"""Draw the pictures of the simulated robot's camera along a drive, with poses and truth, and write
them to a folder.

For each column of a picture a ray is cast over the floor plan; walls and things are upright, so a
hit is a stretch of that column. Nearer surfaces hide farther ones, pixel by pixel. Colours are
uniform: floor, ceiling and walls are grey, each thing has a colour of its own, so that a detector
with known weights can find the things and an encoder that only averages colours can tell those of
one class apart. Things of one class have hues as different as possible.

A folder gets a JPEG for each picture, named by the time it was taken, ``poses.csv`` with a pose of
the localisation for each, and ``truth.jsonl`` with the things that each shows; `mapfold detect`
reads the first two.
"""

import itertools
import math
import struct
import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from eventsrc.adapters.detector.vision import encode_jpeg
from eventsrc.adapters.sim.detector import CAMERA_HEIGHT_M, FOCAL_PX, HEIGHT_PX, WIDTH_PX, Box
from eventsrc.adapters.sim.drive import TruePose, drive, keyframes
from eventsrc.adapters.sim.floorplan import Rect
from eventsrc.adapters.sim.house import House, build_house
from eventsrc.adapters.sim.random_streams import stream
from eventsrc.adapters.sim.simulation import (
    DEFAULT_SEED,
    EXPLORER,
    encode,
    noisy_pose,
    plan_tour,
    start_of,
    subscribed,
)
from eventsrc.base.errors import MisuseError
from eventsrc.base.progress import reported
from eventsrc.base.user_files import write_files, written_whole
from eventsrc.envelope.model import RunId
from eventsrc.record.transport.session import Session

Colour = tuple[int, int, int]
"""Red, green and blue."""

_CEILING: Final = 205
_FLOOR: Final = 96
_WALLS: Final = (150, 172)
"""Greys of walls along y and along x."""
_WALL_HEIGHT_M: Final = 2.5
_NEAR_M: Final = 0.05
_FAR_M: Final = 1e6
_LEVELS: Final = (0, 64, 128, 192, 255)
_LEAST_CHROMA: Final = 128


@dataclass(frozen=True, slots=True)
class Shown:
    """A thing in a picture: the box around the pixels that show it, and their number."""

    instance: str
    class_name: str
    box: Box
    pixels: int


@dataclass(frozen=True, slots=True)
class View:
    """A drawn picture, rows of blue, green and red, and the things that it shows."""

    pixels: NDArray[np.uint8]
    shown: tuple[Shown, ...]


def thing_colours(house: House) -> dict[str, Colour]:
    """The colour of each thing by its instance; no two are alike, and none is grey."""
    free = [
        (r, g, b)
        for r in _LEVELS
        for g in _LEVELS
        for b in _LEVELS
        if max(r, g, b) - min(r, g, b) >= _LEAST_CHROMA
    ]
    taken: dict[str, list[Colour]] = {}
    colours: dict[str, Colour] = {}
    for thing in house.things:
        others = taken.setdefault(thing.model.class_name, [])
        best = min(free, key=lambda colour: (_nearest_hue(colour, others), colour))
        free.remove(best)
        others.append(best)
        colours[thing.instance] = best
    return colours


def _nearest_hue(colour: Colour, others: list[Colour]) -> int:
    """The greatest cosine between the hue of ``colour`` and those of ``others``, in thousandths."""
    return max((round(1000 * _hue_cosine(colour, other)) for other in others), default=-1000)


def _hue_cosine(one: Colour, other: Colour) -> float:
    a, b = ([3 * value - sum(colour) for value in colour] for colour in (one, other))
    dot = sum(x * y for x, y in zip(a, b, strict=True))
    return dot / math.sqrt(sum(x * x for x in a) * sum(y * y for y in b))


class Camera:
    """Draws pictures in one house."""

    def __init__(self, house: House, colours: Mapping[str, Colour] | None = None) -> None:
        self._things = house.things
        self.colours = thing_colours(house) if colours is None else colours
        walls = house.plan.walls
        self._walls = np.array([(w.x0, w.y0, w.x1, w.y1) for w in walls])
        self._edges = np.array([_edges(thing.footprint) for thing in house.things]).reshape(-1, 4)
        greys = [(grey,) * 3 for grey in (_CEILING, _FLOOR, *_WALLS)]
        own = [self.colours[thing.instance] for thing in house.things]
        self._palette = np.array([*own, *greys], np.uint8)[:, ::-1]
        first = len(own)
        self._empty = np.full((HEIGHT_PX, 1), first, np.uint8)
        self._empty[HEIGHT_PX // 2 :] = first + 1
        self._wall_kinds = np.array([first + 2 + (w.y0 == w.y1) for w in walls], np.uint8)
        columns = np.arange(WIDTH_PX) + 0.5
        self._slopes = (WIDTH_PX / 2 - columns) / FOCAL_PX
        self._rows = (np.arange(HEIGHT_PX) + 0.5).reshape(-1, 1)

    def draw(self, pose: TruePose) -> View:
        """The picture from ``pose``."""
        ahead = self._depths(self._walls, pose)
        nearest = ahead.argmin(axis=0)
        wall = ahead[nearest, np.arange(WIDTH_PX)]
        # For each pixel an index into the palette.
        shows = np.where(
            self._between(wall, 0.0, _WALL_HEIGHT_M, slice(None)),
            self._wall_kinds[nearest],
            self._empty,
        )
        sides = self._depths(self._edges, pose)
        sides = sides.reshape(len(self._things), 4, WIDTH_PX)
        fronts = sides.min(axis=1)
        backs = np.where(np.isfinite(sides), sides, 0.0).max(axis=1)
        fronts[fronts >= wall] = math.inf
        depth = np.full((HEIGHT_PX, WIDTH_PX), math.inf, np.float32)
        drawn = np.flatnonzero(np.isfinite(fronts).any(axis=1)).tolist()
        parts = [self._draw_thing(i, fronts[i], backs[i], shows, depth) for i in drawn]
        shown = [
            self._shown(*each) for each in zip(drawn, parts, [shows] * len(drawn), strict=True)
        ]
        return View(self._palette[shows], tuple(each for each in shown if each is not None))

    def _draw_thing(
        self,
        index: int,
        front: NDArray[np.float64],
        back: NDArray[np.float64],
        shows: NDArray[np.uint8],
        depth: NDArray[np.float32],
    ) -> tuple[slice, slice]:
        """Draw one thing; return the rows and columns that may show it."""
        hit = np.flatnonzero(np.isfinite(front))
        columns = slice(int(hit[0]), int(hit[-1]) + 1)
        front, back = front[columns], np.minimum(back[columns], _FAR_M)
        model = self._things[index].model
        low, high = model.base_m, model.base_m + model.height_m
        scale = FOCAL_PX / float(front.min())
        top = math.floor(HEIGHT_PX / 2 - scale * max(high - CAMERA_HEIGHT_M, 0.0))
        bottom = math.ceil(HEIGHT_PX / 2 - scale * min(low - CAMERA_HEIGHT_M, 0.0))
        rows = slice(max(0, top), min(HEIGHT_PX, bottom))
        inside = self._between(front, low, high, rows)
        near = np.broadcast_to(front, inside.shape)
        if high < CAMERA_HEIGHT_M or low > CAMERA_HEIGHT_M:  # its upper or lower face shows
            level = high if high < CAMERA_HEIGHT_M else low
            with np.errstate(divide="ignore"):
                plane = FOCAL_PX * (level - CAMERA_HEIGHT_M) / (HEIGHT_PX / 2 - self._rows[rows])
            face = (plane > front) & (plane <= back)
            inside |= face
            near = np.where(face, plane, near)
        inside &= near < depth[rows, columns]
        np.copyto(shows[rows, columns], index, where=inside)
        np.copyto(depth[rows, columns], near, where=inside, casting="same_kind")
        return rows, columns

    def _between(
        self, depth: NDArray[np.float64], low_m: float, high_m: float, rows: slice
    ) -> NDArray[np.bool_]:
        """Which pixels of columns show heights of ``low_m`` to ``high_m`` at this depth."""
        scale = FOCAL_PX / depth  # 0 where nothing is met
        top = HEIGHT_PX / 2 - scale * (high_m - CAMERA_HEIGHT_M)
        bottom = HEIGHT_PX / 2 - scale * (low_m - CAMERA_HEIGHT_M)
        between: NDArray[np.bool_] = (self._rows[rows] >= top) & (self._rows[rows] < bottom)
        return between

    def _depths(self, segments: NDArray[np.float64], pose: TruePose) -> NDArray[np.float64]:
        """The depth in metres at which each column's ray meets each segment, shape (segments,
        columns); infinite where it does not."""
        cos, sin = math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
        moved = segments - np.array((pose.x, pose.y) * 2)
        ahead = moved[:, 0::2] * cos + moved[:, 1::2] * sin
        left = moved[:, 1::2] * cos - moved[:, 0::2] * sin
        run, rise = np.diff(ahead), np.diff(left)
        across = rise - self._slopes * run
        with np.errstate(invalid="ignore", divide="ignore"):
            along = (self._slopes * ahead[:, :1] - left[:, :1]) / across
            depth = ahead[:, :1] + along * run
        met = (along >= 0.0) & (along <= 1.0) & (depth > _NEAR_M)
        return np.where(met, depth, math.inf)

    def _shown(
        self, index: int, part: tuple[slice, slice], shows: NDArray[np.uint8]
    ) -> Shown | None:
        mine = shows[part] == index
        columns = np.flatnonzero(mine.any(axis=0))
        if not len(columns):
            return None
        rows = np.flatnonzero(mine.any(axis=1))
        x, y = part[1].start, part[0].start
        low = float(x + columns[0]), float(y + rows[0])
        high = float(x + columns[-1] + 1), float(y + rows[-1] + 1)
        thing = self._things[index]
        return Shown(
            thing.instance, thing.model.class_name, (*low, *high), int(np.count_nonzero(mine))
        )


def _edges(rect: Rect) -> list[tuple[float, float, float, float]]:
    corners = [(rect.x0, rect.y0), (rect.x1, rect.y0), (rect.x1, rect.y1), (rect.x0, rect.y1)]
    return [(*a, *b) for a, b in zip(corners, [*corners[1:], corners[0]], strict=True)]


PER_S: Final = 5.0
_SLACK_S: Final = 1e-6


@dataclass(frozen=True, slots=True)
class CameraPicture:
    """A picture with its time, the pose of the localisation, and the true things in it."""

    stamp_s: float
    time_s: float
    """Seconds since the drive began."""
    pose: dict[str, float]
    jpeg: bytes
    truth: dict[str, Any]


def camera_pictures(
    seed: int = DEFAULT_SEED,
    run: str = EXPLORER,
    *,
    per_s: float = PER_S,
    until_s: float = math.inf,
) -> Iterator[CameraPicture]:
    """The pictures of ``run`` through house ``seed``, ``per_s`` a second; 0 is one for each of the
    run's keyframes. ``until_s`` ends the drive sooner."""
    house = build_house(seed)
    camera = Camera(house)
    run_id, start_s = RunId(f"sim-{seed}-{run}"), start_of(run)
    driven = itertools.takewhile(
        lambda pose: pose.time_s <= until_s, drive(house.grid, plan_tour(house, run))
    )
    poses = list(_at_rate(driven, per_s) if per_s > 0 else keyframes(driven))
    for number, pose in enumerate(reported(poses, "drawing", len(poses), "pictures")):
        rng = stream("picture", run_id, number)
        view = camera.draw(pose)
        stamp_s = round(start_s + pose.time_s, 3)
        truth = {
            "stamp": stamp_s,
            "room": house.plan.room_at(pose.x, pose.y),
            "things": [
                {"instance": shown.instance, "class": shown.class_name, "box": shown.box}
                for shown in view.shown
            ],
        }
        noisy = {name.removeprefix("map_"): at for name, at in noisy_pose(pose, rng).items()}
        yield CameraPicture(stamp_s, pose.time_s, noisy, encode_jpeg(view.pixels), truth)


def _at_rate(poses: Iterator[TruePose], per_s: float) -> Iterator[TruePose]:
    taken = 0
    for pose in poses:
        if pose.time_s >= taken / per_s - _SLACK_S:
            taken = math.floor(pose.time_s * per_s + _SLACK_S) + 1
            yield pose


def write_pictures(pictures: Iterator[CameraPicture], folder: Path, stop: threading.Event) -> int:
    """Write pictures, poses and truth until ``stop`` is set; return the number of pictures.

    Poses and truth get their names at the end, so that a folder without them is incomplete. Raises
    MisuseError if the folder is not empty or no file can be made in it, MapfoldError where writing
    fails.
    """
    written = 0
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise MisuseError(f"{folder}: this folder is not empty; choose another")
    except OSError as error:
        raise MisuseError(
            f"{folder}: cannot be written: {error.strerror}; choose another"
        ) from None
    with (
        written_whole(folder / "poses.csv") as poses,
        written_whole(folder / "truth.jsonl") as truth,
    ):
        poses.write(b"stamp,x,y,yaw\n")
        for picture in pictures:
            if stop.is_set():
                break
            write_files({folder / f"{picture.stamp_s:.3f}.jpg": picture.jpeg})
            at = picture.pose
            line = f"{picture.stamp_s:.3f},{at['x']},{at['y']},{at['yaw']}\n"
            poses.write(line.encode())
            truth.write(encode(picture.truth) + b"\n")
            written += 1
    return written


def publish_pictures(
    session: Session, pictures: Iterator[CameraPicture], image_key: str, pose_key: str
) -> int:
    """Publish pictures and poses to a subscriber; return the number of pictures."""
    poses = session.publisher(pose_key)
    images = subscribed(session, image_key, 30.0, "mapfold detect")
    sent = 0
    for picture in pictures:
        poses.put(encode({"stamp": picture.stamp_s, **picture.pose}))
        images.put(compressed_image(picture.stamp_s, picture.jpeg))
        sent += 1
    session.confirm()
    return sent


def compressed_image(stamp_s: float, jpeg: bytes) -> bytes:
    """sensor_msgs/CompressedImage in CDR, little endian."""
    seconds = math.floor(stamp_s)
    body = struct.pack("<iI", seconds, round((stamp_s - seconds) * 1e9))
    for text in (b"camera\0", b"jpeg\0"):
        body += struct.pack("<I", len(text)) + text
        body += bytes(-len(body) % 4)
    return b"\0\1\0\0" + body + struct.pack("<I", len(jpeg)) + jpeg
